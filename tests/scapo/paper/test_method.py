# SPDX-License-Identifier: MIT
"""SCAPO as a whole: what its predictions must do whatever its weights, and that it learns."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from scapo.categories import CATEGORIES
from scapo.geometry.points import normalise
from scapo.geometry.rigid import apply, invert, joint_motion
from scapo.method import Step
from scapo.paper.autoencoder import EncoderConfig
from scapo.paper.config import ScapoConfig
from scapo.paper.method import ARTICULATE, CANONICALISE, LOOKS, Scapo
from scapo.records import map_tensors
from scapo.types import Labels, Observation, Prediction
from tests.helpers.hinged import plates
from tests.helpers.strategies import generator, is_rotation, rigid_motions
from tests.helpers.tiny import TINY, tiny

STAGES = (CANONICALISE, ARTICULATE)


def at(stage: str, progress: float, seed: int) -> Step:
    """Somewhere in the training; which samples it holds is nothing to this method."""
    index = torch.arange(1)
    return Step(stage=stage, progress=progress, generator=generator(seed), index=index, total=1)


def trained(steps: int = 8, category: str = "laptop") -> Scapo:
    """A model whose batch statistics have seen some clouds."""
    model = tiny(category=category)
    observation, _ = plates(16, 96)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    for stage in STAGES:
        model.train()
        model.start(stage, observation, Labels(), generator(1))
        model.train()
        for k in range(steps):
            step = at(stage, 0.6, k)
            optimizer.zero_grad()
            torch.stack(list(model.losses(observation, Labels(), step).values())).sum().backward()
            optimizer.step()
    return model.eval()


def predict(model: Scapo, points: torch.Tensor) -> Prediction:
    return model.predict(Observation(points=points))


def test_stages_freeze_the_encoder_for_half_of_the_second() -> None:
    first, second = tiny().stages()
    assert [group.module for group in first.parameters] == ["encoder", "decoder"]
    late = {group.module: (group.rate, group.begin) for group in second.parameters}
    assert late["encoder"] == late["decoder"] == (0.1, 0.5)
    assert {late[name] for name in late if name not in ("encoder", "decoder")} == {(1.0, 0.0)}
    _, frozen = tiny(config=replace(TINY, encoder_in_stage_2="frozen")).stages()
    assert "encoder" not in {group.module for group in frozen.parameters}
    one = tiny(config=replace(TINY, epochs=(7,))).stages()
    assert [stage.epochs for stage in one] == [7, 7]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-8), (torch.float32, 1e-3)])
def test_predictions_move_with_the_camera(dtype: torch.dtype, tolerance: float) -> None:
    model = tiny().to(dtype).eval()
    model.load_state_dict(trained_state())
    points = plates(12, 96, seed=5)[0].points.to(dtype)
    motion = rigid_motions(3, 12, dtype=dtype)
    before, after = predict(model, points), predict(model, apply(motion, points))
    close = {"atol": tolerance, "rtol": 0}
    assert_close(after.part_weight, before.part_weight, **close)
    assert before.joints is not None
    assert after.joints is not None
    assert before.camera_T_part is not None
    assert_close(after.joints.state, before.joints.state, **close)
    assert_close(after.joints.pivot, apply(motion, before.joints.pivot), **close)
    turned = before.joints.axis @ motion[:, :3, :3].mT
    assert_close(after.joints.axis, turned, **close)
    assert_close(after.camera_T_part, motion[:, None] @ before.camera_T_part, **close)
    assert_close(after.canonical_points, before.canonical_points, **close)


_STATE: dict[str, torch.Tensor] = {}


def trained_state() -> dict[str, torch.Tensor]:
    if not _STATE:
        _STATE.update(trained().state_dict())
    return _STATE


def test_quick_asks_the_encoder_about_several_samplings_and_fast_about_one() -> None:
    model = tiny(config=replace(TINY, points=48)).eval()
    observation = Observation(points=plates(4, 96)[0].points)
    cloud, _ = normalise(observation.points)
    asked = []
    hook = model.encoder.register_forward_pre_hook(lambda _, args: asked.append(args[0]))
    fast, quick = model.predict(observation), model.predict(observation, "quick")
    hook.remove()
    assert [points.shape[1] for points in asked] == [48] * (1 + LOOKS)
    assert torch.equal(asked[0], cloud[:, ::2])
    assert len({float(points[0, 0, 0]) for points in asked[1:]}) > LOOKS // 2
    assert fast.camera_T_part is not None
    assert quick.camera_T_part is not None
    assert not torch.equal(fast.camera_T_part, quick.camera_T_part)
    again = model.predict(observation, "quick").camera_T_part
    assert again is not None
    assert torch.equal(again, quick.camera_T_part)


def test_predictions_scale_with_the_cloud() -> None:
    model = tiny().double()
    model.load_state_dict(trained_state())
    points = plates(4, 96, seed=5)[0].points.double()
    before, after = predict(model.eval(), points), predict(model, 3 * points)
    assert before.joints is not None
    assert after.joints is not None
    assert before.canonical_points is not None
    close = {"atol": 1e-8, "rtol": 0}
    assert_close(after.part_weight, before.part_weight, **close)
    assert_close(after.joints.pivot, 3 * before.joints.pivot, **close)
    assert_close(after.joints.state, before.joints.state, **close)
    assert_close(after.canonical_points, 3 * before.canonical_points, **close)


def test_a_prismatic_state_is_in_metres() -> None:
    model = trained(3, "drawer").double()
    points = plates(4, 96, seed=5)[0].points.double()
    before, after = predict(model, points), predict(model, 3 * points)
    assert before.joints is not None
    assert after.joints is not None
    assert before.joints.state.abs().max() > 0
    assert_close(after.joints.state, 3 * before.joints.state, atol=1e-8, rtol=0)


@pytest.mark.parametrize("category", ["laptop", "eyeglasses", "drawer"])
def test_predictions_are_well_formed(category: str) -> None:
    prediction = predict(trained(2, category), plates(3, 96)[0].points)
    parts, joints = len(CATEGORIES[category].parts), len(CATEGORIES[category].joints)
    assert prediction.part_weight.shape == (3, 96, parts)
    assert_close(prediction.part_weight.sum(-1), torch.ones(3, 96))
    assert prediction.camera_T_part is not None
    assert prediction.camera_T_part.shape == (3, parts, 4, 4)
    assert bool(is_rotation(prediction.camera_T_part[..., :3, :3]).all())
    assert prediction.joints is not None
    assert prediction.joints.axis.shape == (3, joints, 3)
    assert_close(prediction.joints.axis.norm(dim=-1), torch.ones(3, joints))


def test_part_poses_differ_by_the_joint_motion() -> None:
    """The child's pose is the base's followed by the relative state about the predicted axis."""
    model = tiny().eval()
    model.load_state_dict(trained_state())
    points = plates(4, 96, seed=5)[0].points
    prediction = predict(model, points)
    joints, poses = prediction.joints, prediction.camera_T_part
    assert joints is not None
    assert poses is not None
    motion = joint_motion(joints.pivot[:, 0], joints.axis[:, 0], joints.state[:, 0], "revolute")
    assert_close(poses[:, 1] @ invert(poses[:, 0]), motion, atol=1e-4, rtol=0)


def test_the_record_places_joints_as_the_published_evaluator_does() -> None:
    model = tiny().eval()
    model.load_state_dict(trained_state())
    points = plates(4, 96, seed=5)[0].points
    prediction = predict(model, points)
    record, joints = prediction.record, prediction.joints
    assert record is not None
    assert joints is not None
    inside = record["S_joint"][:, 0] + record["T_select"]
    placed = (record["R_select"] @ inside[..., None])[..., 0]
    radius = (points - points.mean(1, keepdim=True)).norm(dim=-1).mean(1)
    metres = placed * (radius / 0.25)[:, None] + points.mean(1)
    assert_close(metres, joints.pivot[:, 0])
    states = record["S_angl"].diff(dim=-1) - record["I_angl"].diff(dim=-1)
    assert_close(states[..., 0], joints.state)


def test_labels_change_nothing_unless_supervised() -> None:
    observation, labels = plates(8, 96)
    step = at(ARTICULATE, 0.1, 0)
    plain = tiny()
    kept = labels.keep(plain.supervision)
    assert kept == Labels()
    assert "labelled_segmentation" not in plain.losses(observation, kept, step)
    config = replace(TINY, supervision=("segmentation", "joint"))
    supervised = tiny(config=config)
    terms = supervised.losses(observation, labels.keep(supervised.supervision), step)
    assert terms["labelled_segmentation"] > 0
    assert terms["labelled_joints"] > 0
    assert supervised.variant == "cpu-SJ"


def test_supervised_joints_do_not_depend_on_the_random_pose() -> None:
    """The same labelled error whatever the augmentation, since the model moves along."""
    observation, labels = plates(8, 96)
    model = trained_supervised()
    found = [
        model.losses(
            observation,
            labels.keep(model.supervision),
            at(ARTICULATE, 0.1, seed),
        )["labelled_joints"]
        for seed in (1, 2)
    ]
    assert_close(found[0], found[1], atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(("category", "either"), [("laptop", True), ("oven", False)])
def test_supervised_terms_take_either_order_where_parts_exchange(
    category: str, either: bool
) -> None:
    """Screen and base of a laptop change names and nothing changes; an oven's door is no body."""
    observation, labels = plates(8, 96)
    model = trained_supervised("segmentation", category=category)
    assert labels.part is not None
    found = [
        model.losses(observation, Labels(part=part), at(ARTICULATE, 0.1, 1))[
            "labelled_segmentation"
        ].item()
        for part in (labels.part, 1 - labels.part)
    ]
    assert (found[0] == pytest.approx(found[1], rel=1e-4)) == either


def test_temples_change_places_with_their_hinges() -> None:
    """The order is one for both terms: parts 1 and 2 go with joints 0 and 1."""
    model = trained_supervised("segmentation", "joint", category="eyeglasses")
    points = plates(4, 96)[0].points
    part = torch.randint(3, (4, 96), generator=generator(2))
    said = model.predict(Observation(points=points)).joints
    assert said is not None

    def total(names: list[int], order: list[int]) -> float:
        joints = map_tensors(said, lambda x: x[:, order])
        labels = Labels(part=torch.tensor(names)[part], joints=joints)
        terms = model.losses(Observation(points=points), labels, at(ARTICULATE, 0.1, 1))
        return sum(terms[name].item() for name in terms if name.startswith("labelled"))

    assert total([0, 2, 1], [1, 0]) == pytest.approx(total([0, 1, 2], [0, 1]), rel=1e-3)
    assert total([0, 1, 2], [1, 0]) != pytest.approx(total([0, 1, 2], [0, 1]), rel=1e-3)


def trained_supervised(*labels: str, category: str = "laptop") -> Scapo:
    config = replace(TINY, supervision=labels or ("joint",))
    model = tiny(config=config, category=category)
    if category == "eyeglasses":
        return model.eval()
    model.load_state_dict(trained_state())
    model.eval()
    model._freeze = lambda step: None
    return model


def test_the_template_starts_as_the_medoid() -> None:
    model, observation = tiny(), plates(16, 96)[0]
    before = model.template.points.clone()
    model.start(CANONICALISE, observation, Labels(), generator(0))
    assert torch.equal(model.template.points, before)
    model.start(ARTICULATE, observation, Labels(), generator(0))
    explanation = model.explain(observation.points - observation.points.mean(1, keepdim=True))
    assert not torch.equal(model.template.points, before)
    assert explanation.residual.abs().max() == 0
    assert_close(explanation.keypoints, explanation.template_keypoints)
    random = tiny(config=replace(TINY, template_start="random"))
    random.start(ARTICULATE, observation, Labels(), generator(0))
    assert torch.equal(random.template.points, before)


def test_the_frozen_half_leaves_batch_statistics_alone() -> None:
    model, observation = tiny(), plates(8, 96)[0]
    model.train()
    before = {k: v.clone() for k, v in model.encoder.state_dict().items()}
    step = at(ARTICULATE, 0.2, 0)
    model.losses(observation, Labels(), step)
    assert all(torch.equal(v, before[k]) for k, v in model.encoder.state_dict().items())
    model.losses(observation, Labels(), replace(step, progress=0.6))
    assert any(not torch.equal(v, before[k]) for k, v in model.encoder.state_dict().items())


@pytest.mark.parametrize("stage", STAGES)
def test_losses_repeat_from_their_generator(stage: str) -> None:
    observation, _ = plates(8, 96)
    state = torch.get_rng_state()
    found = []
    for _ in range(2):
        model = tiny()
        model.train()
        step = at(stage, 0.6, 7)
        found.append(model.losses(observation, Labels(), step))
    assert list(found[0]) == list(found[1])
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])
    assert torch.equal(state, torch.get_rng_state())


def test_variants_name_what_differs() -> None:
    assert Scapo(ScapoConfig(), CATEGORIES["laptop"], generator(0)).variant == ""
    without = replace(TINY, loss=replace(TINY.loss, without=("shape_var",)))
    assert tiny(config=without).variant == "cpu-wo_shape_var"
    other = replace(TINY, gamma=0.02, supervision=("joint",), epochs=(1, 1))
    assert tiny(config=other).variant == "cpu-J-gamma=0.02"
    gram = ScapoConfig(encoder=EncoderConfig(projection="gram-schmidt"))
    assert Scapo(gram, CATEGORIES["laptop"], generator(0)).variant == (
        "encoder.projection=gram-schmidt"
    )


def test_both_stages_learn() -> None:
    observation, _ = plates(16, 96)
    model = tiny()
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    for stage, term in ((CANONICALISE, "rec"), (ARTICULATE, "recon")):
        model.start(stage, observation, Labels(), generator(1))
        model.train()
        history = []
        for k in range(30):
            step = at(stage, 0.1, k)
            terms = model.losses(observation, Labels(), step)
            optimizer.zero_grad()
            torch.stack(list(terms.values())).sum().backward()
            optimizer.step()
            history.append(terms[term].item())
        assert sum(history[-3:]) < 0.7 * sum(history[:3]), stage
