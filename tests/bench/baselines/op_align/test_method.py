# SPDX-License-Identifier: MIT
"""OP-Align as a whole: sizes, equivariance, the choice, part alignment, labels, that it learns."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

from bench.baselines.op_align.backbone import BackboneConfig
from bench.baselines.op_align.heads import (
    DecoderConfig,
    HypothesisConfig,
    PointNetConfig,
)
from bench.baselines.op_align.method import OpAlign, OpAlignConfig, cpu_config
from bench.compat.chain import Chain, inverse_chain
from scapo.categories import CATEGORIES
from scapo.equivariant.anchors import icosahedron
from scapo.equivariant.e2pn import QuotientBlock
from scapo.geometry.points import normalise
from scapo.geometry.rigid import apply
from scapo.method import Step, StepDecay
from scapo.types import Joints, Labels, Observation
from tests.helpers.hinged import plates
from tests.helpers.small import assert_turns_with, settle
from tests.helpers.strategies import generator, normal

TINY = replace(
    cpu_config(),
    backbone=BackboneConfig(
        channels=(4, 8), depth=(2, 1), radius=0.25, neighbours=8, points=48, sampling="stride"
    ),
    hypotheses=HypothesisConfig(pooled=8, width=16, hidden=8, code=8, residual_range=pi / 4),
    decoder=DecoderConfig(width=16, points=40),
    point_net=PointNetConfig(width=8, blocks=2, segmentation=(8,), joint=(8, 8)),
    chosen_by=None,
    batch=4,
)


def step(seed: int = 0, progress: float = 0.0) -> Step:
    return Step(
        stage="align",
        progress=progress,
        generator=generator(seed),
        index=torch.arange(1),
        total=1,
    )


def tiny(category: str = "laptop", config: OpAlignConfig = TINY) -> OpAlign:
    """With the statistics of a batch."""
    made = settle(OpAlign(config, CATEGORIES[category], generator(0)))
    with torch.no_grad():
        made.losses(plates(8, 48)[0], Labels(), step())
    return made.eval()


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_published_sizes() -> None:
    made = OpAlign(OpAlignConfig(color_weight=1.0), CATEGORIES["laptop"], generator(0))
    backbone = count(made.backbone.blocks)
    sizes = {
        "backbone": (backbone, 2.39e6),
        "head": (count(made.backbone) - backbone + count(made.head), 2.32e6),
        # Published 1.86: 0.07 of it are layers whose output nothing uses.
        "point network": (count(made.point_network), 1.86e6),
        "decoder": (count(made.decoder), 1.85e6),
        "all": (count(made), 8.42e6),
    }
    assert {
        name for name, (ours, theirs) in sizes.items() if abs(ours / theirs - 1) > 0.05
    } == set()
    # The branch of colours is made where they count alone.
    grey = OpAlign(OpAlignConfig(), CATEGORIES["laptop"], generator(0))
    assert count(made) - count(grey) == 256 * 256 + 256 + 2 * 256 + 256 * 3072 + 3072
    radii = [level.radius for level in OpAlignConfig().backbone.plan()]
    np.testing.assert_allclose(radii, [0.2, 0.2828, 0.4, 0.4, 0.5657, 0.5657, 0.8], atol=1e-4)
    assert [level.neighbours for level in OpAlignConfig().backbone.plan()] == [32, 16] * 3 + [32]


@torch.no_grad()
@pytest.mark.parametrize("turn", [7, 33, 58])
def test_a_cloud_turned_by_an_anchor_has_its_prediction_turned(turn: int) -> None:
    made = tiny()
    points = plates(2, 48, 9)[0].points
    assert_turns_with(made, points, icosahedron().rotations[turn].float())


@torch.no_grad()
def test_the_chosen_hypothesis_is_that_of_brute_force() -> None:
    made = tiny()
    points, _ = normalise(plates(3, 48, 4)[0].points)
    e = made.explain(points, torch.full_like(points, 0.5), None)
    for b in range(3):
        costs = []
        for k in range(60):
            turn = e.hypotheses.rotation[b, k].numpy()
            aligned = points[b].numpy() @ turn - e.hypotheses.translation[b, k].numpy()
            table = np.abs(aligned[:, None] - e.shape.points[b].numpy()[None]).sum(-1)
            costs.append(table.min(1).mean())
        best = int(np.argmin(costs))
        assert_close(e.rotation[b], e.hypotheses.rotation[b, best])
        np.testing.assert_allclose(e.distance[b].numpy(), costs, rtol=1e-4)
        expected = points[b] @ e.rotation[b] - e.translation[b]
        assert_close(e.aligned[b], expected)


def minimal(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The least rotation between two directions, by scipy."""
    normal_ = np.cross(source, target)
    angle = np.arctan2(np.linalg.norm(normal_), source @ target)
    return Rotation.from_rotvec(normal_ / np.linalg.norm(normal_) * angle).as_matrix()


@torch.no_grad()
@pytest.mark.parametrize("category", ["oven", "drawer"])
def test_part_poses_are_the_rigid_motions_of_the_joints(category: str) -> None:
    made = tiny(category)
    observation = plates(2, 48, 3)[0]
    points, similarity = normalise(observation.points)
    e = made.explain(points, torch.full_like(points, 0.5), None)
    pose = made.predict(observation).camera_T_part
    assert pose is not None
    y = normal(5, 7, 3).numpy()
    for b in range(2):
        names = ("pivot", "axis", "state")
        s, i = (
            {n: getattr(one.joints, n)[b, 0].double().numpy() for n in names}
            for one in (e.observed, e.canonical)
        )
        for side in range(2):
            change = s["axis"] * (s["state"][side] - i["state"][side])
            moved = (y - i["pivot"]) @ minimal(i["axis"], s["axis"]).T
            if category == "oven":
                moved = Rotation.from_rotvec(change).apply(moved)
            else:
                moved = moved + change
            aligned = moved + s["pivot"] + e.translation[b].double().numpy()
            placed = aligned @ e.rotation[b].double().numpy().T
            there = apply(pose[b, side].double(), torch.from_numpy(y / similarity.scale[b].item()))
            expected = similarity.inverse(torch.from_numpy(placed)[None].float().expand(2, -1, -1))
            np.testing.assert_allclose(there.numpy(), expected[b].numpy(), atol=2e-3)


@torch.no_grad()
@pytest.mark.parametrize("category", ["oven", "eyeglasses"])
def test_the_record_gives_the_evaluator_the_same_poses(category: str) -> None:
    made = tiny(category)
    observation = plates(2, 48, 3)[0]
    points, similarity = normalise(observation.points)
    e = made.explain(points, torch.full_like(points, 0.5), None)
    said = made.predict(observation)
    assert said.record is not None
    record = {name: value.double().numpy() for name, value in said.record.items()}
    assert_close(
        points @ torch.from_numpy(record["R_select"]).float()
        - torch.from_numpy(record["T_select"]).float()[:, None],
        e.aligned,
        atol=1e-5,
        rtol=0,
    )
    parts = len(CATEGORIES[category].parts)
    canon = np.tile(np.eye(3), (parts, 1, 1)), np.zeros((parts, 3))
    turn, move = inverse_chain(record, canon, Chain(revolute=True, corrected=True))
    assert said.camera_T_part is not None
    np.testing.assert_allclose(said.camera_T_part[..., :3, :3].numpy(), turn, atol=0.02)
    shift = similarity.forward(said.camera_T_part[..., :3, 3]).numpy()
    # The published rotation between axes never turns by less than 0.81 degrees.
    np.testing.assert_allclose(shift, move, atol=0.03)


def labelled(count: int = 8) -> tuple[Observation, Labels]:
    return plates(count, 48, 2)


def test_labels_change_nothing_unless_they_are_asked_for() -> None:
    observation, labels = labelled()
    made = tiny().train()
    kept = labels.keep(made.supervision)
    assert kept == Labels()
    terms = made.losses(observation, kept, step())
    assert not {name for name in terms if "labelled" in name}
    asked = OpAlign(
        replace(TINY, supervision=("segmentation", "joint")), CATEGORIES["laptop"], generator(0)
    )
    assert asked.supervision == {"segmentation", "joint"}
    assert asked.variant.startswith("cpu-SJ")
    terms = asked.losses(observation, labels.keep(asked.supervision), step())
    assert {"labelled_segmentation", "labelled_joints"} <= set(terms)


@torch.no_grad()
def test_labelled_terms_are_zero_on_a_perfect_answer() -> None:
    made = tiny()
    observation, labels = labelled(3)
    points, similarity = normalise(observation.points)
    e = made.explain(points, torch.full_like(points, 0.5), None)
    joints = Joints(
        pivot=similarity.inverse(e.place(e.observed.joints.pivot)),
        axis=-e.observed.joints.axis @ e.rotation.mT,
        state=torch.zeros(3, 1),
    )
    part = e.observed.weights.argmax(-1)
    sharp = replace(e, observed=replace(e.observed, weights=torch.eye(2)[part]))
    turn = torch.eye(3).expand(3, 3, 3)
    terms = made._labelled(sharp, Labels(part=part, joints=joints), similarity, turn)
    assert float(terms["labelled_segmentation"]) < 1e-6
    assert float(terms["labelled_joints"]) < 1e-6
    assert labels.part is not None
    other = made._labelled(sharp, Labels(part=1 - part), similarity, turn)
    assert float(other["labelled_segmentation"]) < 1e-6  # a laptop's halves, either way
    made.category = CATEGORIES["oven"]
    wrong = made._labelled(sharp, Labels(part=1 - part), similarity, turn)
    assert float(wrong["labelled_segmentation"]) > 1


def test_schedules_halve_rate_and_rigid_share_together() -> None:
    config = replace(TINY, epochs=8, decay_every=2, direction_noise=0.0)
    made = OpAlign(config, CATEGORIES["laptop"], generator(0)).eval()
    observation, _ = labelled(2)
    shares = []
    for progress in (0.0, 0.24, 0.25, 0.5, 0.99):
        terms = made.losses(observation, Labels(), step(progress=progress))
        shares.append((float(terms["rigid"].detach()), float(terms["art"].detach())))
    rigid = np.array(shares)[:, 0] / shares[0][0]
    np.testing.assert_allclose(rigid, [1, 1, 0.5, 0.25, 0.125], rtol=1e-5)
    art = np.array(shares)[:, 1] / shares[0][1]
    np.testing.assert_allclose(art, [1, 1, 1.5, 1.75, 1.875], rtol=1e-5)
    published = replace(TINY, lr=1e-4, decay_every=16)
    (stage,) = OpAlign(published, CATEGORIES["laptop"], generator(0)).stages()
    assert OpAlignConfig().lr == 1e-4
    assert OpAlignConfig().decay_every == 16
    assert (stage.lr, stage.weight_decay) == (1e-4, 1e-8)
    assert stage.schedule == StepDecay(every=16, factor=0.5)


def test_the_lean_schedule_has_the_four_published_levels() -> None:
    for config in (OpAlignConfig(), cpu_config()):
        assert config.epochs == 4 * config.decay_every


@torch.no_grad()
def test_grey_says_the_same_in_training_and_after() -> None:
    backbone, points = tiny().backbone, normal(0, 2, 48, 3).float()
    first = backbone.blocks[0]
    seen: list[Tensor] = []
    assert isinstance(first, QuotientBlock)
    first.skip.register_forward_hook(lambda *seen_now: seen.append(seen_now[-1]))
    first.skip.linear.weight.add_(0.1)  # a step since the statistics of the last batch
    for training in (False, True):
        backbone.train(training)(points, torch.full_like(points, 0.5))
    assert torch.equal(seen[0], seen[1])


def test_three_parts_agree_on_the_base() -> None:
    made = tiny("eyeglasses").train()
    observation, _ = labelled(4)
    terms = made.losses(observation, Labels(), step())
    assert {"same_turn", "same_base"} <= set(terms)
    assert "same_base" not in tiny().train().losses(observation, Labels(), step())
    said = made.eval().predict(observation)
    assert said.part_weight.shape == (4, 48, 3)
    assert said.camera_T_part is not None
    assert said.camera_T_part.shape == (4, 3, 4, 4)


def test_noise_is_off_at_test_time_unless_asked_for() -> None:
    observation, _ = labelled(2)
    made = tiny()
    again = [made.predict(observation).joints for _ in range(2)]
    assert again[0] is not None
    assert again[1] is not None
    assert torch.equal(again[0].axis, again[1].axis)
    noisy = tiny(config=replace(TINY, test_noise=True)).predict(observation).joints
    assert noisy is not None
    off = (noisy.axis - again[0].axis).abs().max()
    assert 1e-5 < float(off) < 0.02


def test_colours_reach_the_network_and_grey_is_a_half() -> None:
    observation, _ = labelled(2)
    made = tiny()
    grey = Observation(points=observation.points, color=torch.full_like(observation.points, 0.5))
    red = Observation(points=observation.points, color=torch.rand(2, 48, 3, generator=generator(1)))
    plain = made.predict(observation).part_weight
    assert torch.equal(made.predict(grey).part_weight, plain)
    assert not torch.equal(made.predict(red).part_weight, plain)
    blind = tiny(config=replace(TINY, color=False))
    assert torch.equal(blind.predict(red).part_weight, blind.predict(grey).part_weight)
    tinted = tiny(config=replace(TINY, color_weight=0.5)).train()
    terms = tinted.losses(red, Labels(), step())
    sum(terms.values(), torch.zeros(())).backward()
    assert tinted.decoder.color is not None
    gradient = tinted.decoder.color[-1].weight.grad
    assert isinstance(gradient, Tensor)
    assert float(gradient.abs().sum()) > 0


@pytest.mark.parametrize(
    ("rounds", "share"), [(40, 0.9), pytest.param(400, 0.25, marks=pytest.mark.slow)]
)
def test_it_overfits_a_batch(rounds: int, share: float) -> None:
    """By its whole objective: offsets, which could explain any cloud, cost something too."""
    made = OpAlign(replace(TINY, direction_noise=0.0), CATEGORIES["laptop"], generator(0)).train()
    observation, _ = plates(4, 48, 2)
    optimiser = torch.optim.Adam(made.parameters(), lr=5e-3)
    curve = []
    for number in range(rounds):
        terms = made.losses(observation, Labels(), step(number))
        loss = torch.stack(list(terms.values())).sum()
        curve.append(float(loss.detach()))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert np.mean(curve[-5:]) < share * np.mean(curve[:3])
