# SPDX-License-Identifier: MIT
"""EAP as a whole: sizes, equivariance, kinematics, the choice of anchors, that it learns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from bench.baselines.eap import losses
from bench.baselines.eap.layers import EncoderConfig, SlotAttention
from bench.baselines.eap.method import PARTS, USUAL, WHOLE, Eap, EapConfig, cpu_config, spread
from bench.baselines.eap.parts import Kinematics, PartConfig, Pass, Usual
from bench.baselines.eap.whole import WholeConfig
from scapo.categories import CATEGORIES
from scapo.equivariant.anchors import icosahedron
from scapo.equivariant.epn import SeparableBlock
from scapo.first_weights import initialise
from scapo.geometry.points import gather, normalise
from scapo.geometry.rigid import apply, invert, joint_motion
from scapo.method import Step, StepDecay
from scapo.training.optimiser import learning_rate
from scapo.types import Labels
from tests.helpers.hinged import plates
from tests.helpers.small import assert_turns_with, settle
from tests.helpers.strategies import generator, is_rotation, normal, unit_vectors

TINY = replace(
    cpu_config(),
    points=32,
    encoder=EncoderConfig(channels=(4, 8), radii=(0.2, 0.3), neighbours=6),
    whole=WholeConfig(width=12, points=24),
    parts=PartConfig(width=12, points=12, passes=2, rounds=3),
    batch=4,
)


def step(stage: str, seed: int = 0) -> Step:
    index = torch.arange(1)
    return Step(stage=stage, progress=0.0, generator=generator(seed), index=index, total=1)


def tiny(category: str = "laptop", config: EapConfig = TINY) -> Eap:
    """With the statistics of a batch."""
    made = settle(Eap(config, CATEGORIES[category], generator(0)))
    with torch.no_grad():
        for stage in (WHOLE, PARTS):
            made.train()
            made.losses(plates(6, 40)[0], Labels(), step(stage))
    return made.eval()


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_sizes_beside_the_published() -> None:
    made = Eap(EapConfig(), CATEGORIES["laptop"], generator(0))
    # 5.24 M with EPN's 24 kernel points and 12 turns; 13 and 13 here.
    kernels = 11 * (64 * 1 + 128 * 64 + 512 * 128) - (64**2 + 128**2 + 512**2)
    assert abs((count(made.whole_stage.encoder) + kernels) / 5.24e6 - 1) < 0.05
    # 16.27 M with heads that take no part in the published forward pass.
    assert 10.5e6 < count(made) < 11e6
    assert count(Eap(cpu_config(), CATEGORIES["laptop"], generator(0))) < 0.25e6


@torch.no_grad()
@pytest.mark.parametrize("turn", [11, 47])
@pytest.mark.parametrize("category", ["laptop", "eyeglasses"])
def test_a_cloud_turned_by_an_anchor_has_its_prediction_turned(category: str, turn: int) -> None:
    made = tiny(category)
    points = plates(2, 40, 9)[0].points
    assert_turns_with(made, points, icosahedron().rotations[turn].float())


def kinematics(kind: str = "revolute", slots: int = 3) -> Kinematics:
    return Kinematics(
        shapes=normal(0, 2, slots, 5, 3),
        pivots=normal(1, 2, slots, 3),
        axis=unit_vectors(2, 2, 4),
        states=normal(3, 2, slots, 4),
        base=torch.tensor([0, 1]),
        kind="revolute" if kind == "revolute" else "prismatic",
    )


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_motions_are_those_of_scipy(kind: str) -> None:
    made, x = kinematics(kind), normal(5, 6, 3).numpy()
    motions = made.motions()
    for b, base in enumerate((0, 1)):
        middle = made.pivots[b, [s for s in range(3) if s != base]].mean(0).numpy()
        for k in range(4):
            axis, states = made.axis[b, k].numpy(), made.states[b, :, k].numpy()
            for s in range(3):
                y, own = x, states[s] - states[base]
                for about, amount in ((made.pivots[b, s].numpy(), own), (middle, states[base])):
                    turned = Rotation.from_rotvec(axis * amount).apply(y - about) + about
                    y = turned if kind == "revolute" else y + axis * amount
                found = apply(motions[b, s, k], torch.from_numpy(x)).numpy()
                np.testing.assert_allclose(found, y, atol=1e-9)


def test_with_two_parts_both_turn_about_one_pivot() -> None:
    made = kinematics(slots=2)
    motions = made.motions()
    for b, base in enumerate((0, 1)):
        pivot = made.pivots[b, 1 - base]
        for k in range(4):
            for s in range(2):
                turn = Rotation.from_rotvec((made.axis[b, k] * made.states[b, s, k]).numpy())
                x = normal(7, 3, 3)
                expected = turn.apply((x - pivot).numpy()) + pivot.numpy()
                np.testing.assert_allclose(apply(motions[b, s, k], x).numpy(), expected, atol=1e-9)
    assert made.order().tolist() == [[0, 1], [1, 0]]


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_pass_may_name_the_axis_the_other_way_round(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state of both passes together is that of the poses, about the axis of the last one."""
    made, points = tiny(), normal(8, 2, 6, 3)
    first = kinematics(kind, slots=2).only(torch.tensor([0, 1]))
    second = replace(first, axis=-first.axis, states=normal(9, 2, 2, 1))
    told = iter([
        Pass(
            points=points,
            weights=normal(10, 2, 6, 2).softmax(-1),
            anchor=torch.tensor([0, 1]),
            turn=torch.eye(3, dtype=points.dtype).expand(2, 3, 3),
            chosen=one,
        )
        for one in (first, second)
    ])  # fmt: skip
    monkeypatch.setattr(made.part_stage, "forward", lambda *_: next(told))
    last = made.part_stage.passes(points, Usual())[-1]
    order = last.one.chosen.order()
    base, child = gather(last.poses().flatten(2), order).unflatten(2, (4, 4)).unbind(1)
    pivot, axis, state = (value[:, 0] for value in last.joints())
    assert_close(child @ invert(base), joint_motion(pivot, axis, state, first.kind))


@torch.no_grad()
def test_the_chosen_anchors_are_those_of_brute_force() -> None:
    made = tiny(config=replace(TINY, parts=replace(TINY.parts, passes=1)))
    points, _ = normalise(plates(2, 32, 4)[0].points)
    whole, passes = made.explain(points, Usual())
    network = made.whole_stage
    summary = network.readout(points, network.encoder(points))
    residual = torch.nn.functional.normalize(
        network.residual(summary.anchors) + torch.tensor([0.0, 0, 0, 1]), dim=-1
    )
    shape = network.decoder(summary.code)
    anchors = icosahedron().rotations
    for b in range(2):
        costs = []
        for k in range(60):
            turn = anchors[k].numpy() @ Rotation.from_quat(residual[b, k].numpy()).as_matrix()
            table = (points[b].numpy() @ turn)[:, None] - shape[b].numpy()[None]
            square = (table**2).sum(-1)
            costs.append(square.min(1).mean() + square.min(0).mean())
        assert int(whole.anchor[b]) == int(np.argmin(costs))
    one = passes[0].one
    stage = made.part_stage
    aligned = whole.aligned
    found = stage._kinematics(aligned, stage.encoder(aligned), one.weights, None)
    moved = apply(found.motions(), found.shapes[:, :, None])  # (B, S, 60, M, 3)
    costs = torch.stack(
        [
            losses.slot_distances(
                moved[:, :, k : k + 1] @ anchors[k].float().mT, aligned, one.weights
            )
            for k in range(60)
        ],
        -1,
    )
    assert torch.equal(costs[:, 0].argmin(-1), one.anchor)


@torch.no_grad()
def test_a_second_pass_sees_the_first_ones_motions_undone() -> None:
    made = tiny()
    points, _ = normalise(plates(3, 32, 4)[0].points)
    whole, (first, second) = made.explain(points, Usual())
    label = first.one.weights.argmax(-1)
    motion = second.before[torch.arange(3)[:, None], label]
    back = apply(motion, second.one.points[:, :, None])[:, :, 0]
    assert_close(back, whole.aligned, atol=1e-5, rtol=0)
    assert is_rotation(motion[..., :3, :3]).all()
    # What is undone is the joint's motion, not the anchor's turn.
    about = first.one.turn @ first.one.chosen.axis[:, 0, :, None]
    assert_close(motion[:, :, :3, :3] @ about[:, None], about[:, None].expand(-1, 32, -1, -1))


@torch.no_grad()
def test_joints_stay_where_both_parts_turn() -> None:
    made = tiny()
    observation = plates(2, 32, 3)[0]
    points, _ = normalise(observation.points)
    whole, passes = made.explain(points, made._usual())
    last = passes[-1]
    pivot, axis, _ = last.joints()
    poses = last.poses()
    for b in range(2):
        base = int(last.one.chosen.base[b])
        own = last.one.chosen.pivots[b, 1 - base]
        there = apply(poses[b, base], own[None])
        assert_close(there[0], pivot[b, 0], atol=1e-5, rtol=0)
    assert_close(axis.norm(dim=-1), torch.ones(2, 1))
    said = made.predict(observation)
    assert said.joints is not None
    assert_close(said.joints.axis, axis @ whole.rotation.mT, atol=1e-5, rtol=0)


def test_slots_compete_for_points() -> None:
    made = SlotAttention(3, 8, 3)
    initialise(made, generator(0))
    x = normal(0, 2, 20, 8).float()
    weights = made(x)
    assert_close(weights.sum(-1), torch.ones(2, 20))
    order = torch.randperm(20, generator=generator(1))
    assert_close(made(x[:, order]), weights[:, order])
    assert float((weights[..., 0] - weights[..., 1]).abs().max().detach()) > 1e-3


def test_the_last_stage_settles_base_and_anchor_without_labels() -> None:
    made = tiny()
    whole, parts, usual = made.stages()
    assert [group.module for group in whole.parameters] == ["whole_stage"]
    assert [group.module for group in parts.parameters] == ["part_stage"]
    assert usual.epochs == 0
    observation = plates(9, 40, 1)[0]
    assert made._usual() == Usual()
    made.start(USUAL, observation, Labels(), generator(0))
    _, passes = made.explain(normalise(observation.points)[0], Usual())
    said = passes[-1].one
    bases = said.chosen.base.tolist()
    assert bases.count(int(made.usual_base)) >= 5
    anchors = said.anchor[said.chosen.base == made.usual_base].tolist()
    assert anchors.count(int(made.usual_anchor)) == max(map(anchors.count, anchors))
    again = made.explain(normalise(observation.points)[0], made._usual())[1][-1].one
    assert set(again.anchor.tolist()) == {int(made.usual_anchor)}
    assert set(again.chosen.base.tolist()) == {int(made.usual_base)}
    each = tiny(config=replace(TINY, mode="each"))
    each.load_state_dict(made.state_dict())
    assert each._usual() == Usual(base=int(made.usual_base))


def test_rates_fall_as_published_or_within_each_stage() -> None:
    published = Eap(EapConfig(), CATEGORIES["laptop"], generator(0)).stages()
    assert {stage.schedule for stage in published} == {StepDecay(every=2, factor=0.64)}
    assert learning_rate(published[0], 2 / 32) == pytest.approx(0.64e-4)
    for stage in tiny().stages()[:2]:  # however few epochs there are
        rates = [learning_rate(stage, done) for done in (0.0, 0.5, 0.999)]
        np.testing.assert_allclose(rates, [1e-3, 5e-4, 1e-5], rtol=0.02)


@torch.no_grad()
def test_two_slots_turn_about_one_pivot_whichever_is_the_base() -> None:
    made, points = tiny(), normalise(plates(2, 32, 3)[0].points)[0]
    pivots = [made.explain(points, Usual(base=s))[1][-1].one.chosen.pivots for s in range(2)]
    assert_close(pivots[0], pivots[1])
    assert torch.equal(pivots[0][:, 0], pivots[0][:, 1])
    three = tiny("eyeglasses").explain(points, Usual())[1][-1].one.chosen.pivots
    assert float((three[:, 0] - three[:, 1]).abs().min()) > 0


@torch.no_grad()
def test_ones_say_the_same_in_training_and_after() -> None:
    encoder, points = tiny().whole_stage.encoder, normal(0, 2, 32, 3).float()
    first = encoder.blocks[0]
    seen: list[torch.Tensor] = []
    assert isinstance(first, SeparableBlock)
    first.skip.register_forward_hook(lambda *seen_now: seen.append(seen_now[-1]))
    first.skip.linear.weight.add_(0.1)  # a step since the statistics of the last batch
    for training in (False, True):
        encoder.train(training)(points)
    assert torch.equal(seen[0], seen[1])


def test_stage_1_leaves_stage_0_as_it_is() -> None:
    made = tiny().train()
    terms = made.losses(plates(4, 40)[0], Labels(), step(PARTS))
    assert set(terms) == {"whole", "slots", "pivot"}
    torch.stack(list(terms.values())).sum().backward()
    assert all(one.grad is None for one in made.whole_stage.parameters())
    assert not made.whole_stage.training
    assert made.supervision == frozenset()
    assert "pivot" not in tiny("drawer").losses(plates(4, 40)[0], Labels(), step(PARTS))


def test_all_points_take_the_weights_of_their_nearest() -> None:
    few = normal(0, 1, 4, 3)
    points = torch.cat([few + 1e-3, few - 1e-3], 1)
    weights = torch.softmax(normal(1, 1, 4, 3), -1)
    order = torch.tensor([[2, 0, 1]])
    expected = torch.cat([weights, weights], 1)[..., [2, 0, 1]]
    assert_close(spread(points, few, weights, order), expected)


@pytest.mark.parametrize(
    ("rounds", "shares"),
    [(25, (0.8, 0.9)), pytest.param(300, (0.15, 0.25), marks=pytest.mark.slow)],
)
def test_each_stage_overfits_a_batch(rounds: int, shares: tuple[float, float]) -> None:
    config = replace(TINY, parts=replace(TINY.parts, passes=1))
    made = Eap(config, CATEGORIES["laptop"], generator(0))
    observation, _ = plates(2, 32, 2)
    for stage, share in zip((WHOLE, PARTS), shares, strict=True):
        module = made.whole_stage if stage == WHOLE else made.part_stage
        optimiser = torch.optim.Adam(module.parameters(), lr=1e-2)
        made.train()
        curve = []
        for number in range(rounds):
            terms = made.losses(observation, Labels(), step(stage, number))
            loss = torch.stack(list(terms.values())).sum()
            # What is reconstructed: a pivot cannot be near both parts at every shift.
            curve.append(loss.item() - float(terms.get("pivot", torch.zeros(())).detach()))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        assert np.mean(curve[-5:]) < share * np.mean(curve[:3]), stage
