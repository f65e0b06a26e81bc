# SPDX-License-Identifier: MIT
"""NPCS-EPN learns what it is shown, turns with the cloud, and sees no label that is withheld."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from bench.baselines.answers import Target, exchanged
from bench.baselines.npcs_epn import (
    NpcsEpn,
    NpcsEpnConfig,
    belonging,
    cpu_config,
    median,
    nearby,
)
from scapo.categories import CATEGORIES
from scapo.equivariant.anchors import icosahedron
from scapo.geometry.rigid import point_line_distance
from scapo.method import HalfCosine, Step, StepDecay
from scapo.types import Labels, Observation
from tests.helpers.hinged import plates
from tests.helpers.strategies import generator, is_rotation, normal
from tests.helpers.supervised import errors_of

LAPTOP = CATEGORIES["laptop"]
TINY = replace(
    cpu_config(),
    points=64,
    rotated=0.0,
    network=replace(
        cpu_config().network,
        widths=(8, 8),
        strides=(4, 2),
        radii=(0.3, 0.6),
        neighbours=(8, 8),
        frames=4,
        code=16,
        head=(64, 64),
    ),
)


def step(seed: int = 0) -> Step:
    return Step(
        stage="learn", progress=0.0, generator=generator(seed), index=torch.arange(3), total=3
    )


def made(config: NpcsEpnConfig = TINY, seed: int = 0) -> NpcsEpn:
    return NpcsEpn(config, LAPTOP, generator(seed))


def trained(observation: Observation, labels: Labels, steps: int) -> tuple[NpcsEpn, float]:
    """The method, and the last loss."""
    method = made()
    method.start("learn", observation, labels, generator(1))
    optimizer = torch.optim.Adam(method.parameters(), lr=1e-2)
    loss = torch.zeros(())
    for k in range(steps):
        for group in optimizer.param_groups:
            # The batch statistics settle at the end.
            group["lr"] = 1e-2 * max(0.0, 1 - k / (steps - 30))
        loss = torch.stack(list(method.losses(observation, labels, step()).values())).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return method.eval(), float(loss.detach())


@pytest.fixture(scope="module")
def learned() -> tuple[NpcsEpn, Observation, Labels, float]:
    observation, labels = plates(2, 64, seed=3)
    method, loss = trained(observation, labels, 270)
    return method, observation, labels, loss


def test_it_overfits_a_batch(learned: tuple[NpcsEpn, Observation, Labels, float]) -> None:
    method, observation, labels, loss = learned
    errors = errors_of(method, observation, labels)
    assert loss < 0.5
    assert errors["iou"].min() > 0.95
    assert errors["part_rotation"].max() < 2
    assert errors["part_translation"].max() < 0.02
    assert errors["joint_direction"].max() < 1
    assert errors["joint_pivot"].max() < 0.03
    found = method.predict(observation).joints
    assert found is not None
    assert labels.joints is not None
    assert_close(found.state, labels.joints.state, atol=0.02, rtol=0)


def test_the_prediction_turns_with_the_cloud(
    learned: tuple[NpcsEpn, Observation, Labels, float],
) -> None:
    method, observation, _, _ = learned
    centre = observation.points.mean(1, keepdim=True)
    before = method.predict(observation)
    assert before.camera_T_part is not None
    assert before.joints is not None
    for g in (7, 31, 58):
        turn = icosahedron().rotations[g].float()
        after = method.predict(
            Observation(points=(observation.points - centre) @ turn.mT + centre + 0.5)
        )
        assert after.camera_T_part is not None
        assert after.joints is not None
        assert_close(after.part_weight, before.part_weight, atol=1e-3, rtol=0)
        rotation = turn @ before.camera_T_part[..., :3, :3]
        assert_close(after.camera_T_part[..., :3, :3], rotation, atol=5e-3, rtol=0)
        shift = (before.camera_T_part[..., :3, 3] - centre) @ turn.mT + centre + 0.5
        assert_close(after.camera_T_part[..., :3, 3], shift, atol=5e-3, rtol=0)
        assert_close(after.joints.axis, before.joints.axis @ turn.mT, atol=5e-3, rtol=0)
        assert_close(after.joints.state, before.joints.state, atol=1e-2, rtol=0)


def test_answers_are_sound_before_any_training() -> None:
    observation, _ = plates(2, 40)
    found = made().eval().predict(observation)
    assert found.camera_T_part is not None
    assert found.joints is not None
    assert is_rotation(found.camera_T_part[..., :3, :3]).all()
    assert_close(found.joints.axis.norm(dim=-1), torch.ones(2, 1))
    assert bool(torch.isfinite(found.joints.pivot).all())


def test_a_cloud_is_answered_alone_as_in_a_batch() -> None:
    method = made(replace(TINY, points=48)).eval()
    observation, _ = plates(20, 64)
    whole = method.predict(observation)
    for k in (0, 17):
        one = method.predict(Observation(points=observation.points[k : k + 1]))
        assert one.camera_T_part is not None
        assert whole.camera_T_part is not None
        assert_close(one.part_weight[0], whole.part_weight[k], atol=1e-5, rtol=0)
        assert_close(one.camera_T_part[0], whole.camera_T_part[k], atol=1e-3, rtol=0)


@pytest.mark.parametrize("missing", ["part", "camera_T_part", "joints"])
def test_it_declares_every_label_and_needs_them(missing: str) -> None:
    method = made()
    assert method.supervision == {"pose", "segmentation", "joint"}
    observation, labels = plates(2, 40)
    less = replace(labels, **{missing: None})
    with pytest.raises(ValueError, match="expected parts, poses and joints, found some withheld"):
        method.losses(observation, less, step())
    with pytest.raises(ValueError, match="expected parts, poses and joints, found some withheld"):
        method.start("learn", observation, less, generator(0))


def test_foreign_points_count_nowhere_in_the_loss() -> None:
    observation, labels = plates(2, 64)
    assert labels.part is not None
    part = labels.part.clone()
    part[:, :20] = -1
    method = made().eval()
    method.start("learn", observation, replace(labels, part=part), generator(0))
    target = method._normalised(observation, replace(labels, part=part))[1]
    points = observation.points
    answer = method.network(points - points.mean(1, keepdim=True), points)
    changed = replace(
        answer, **{name: getattr(answer, name).clone() for name in ("part", "coordinate", "joint",
                                                                   "heat", "towards", "axis")}
    )  # fmt: skip
    for name in ("part", "coordinate", "joint", "heat", "towards", "axis"):
        getattr(changed, name)[:, :20] = 0.7
    before, after = (method._penalties(points, one, target) for one in (answer, changed))
    assert_close(after, before)
    changed.part[:, 20:] += torch.tensor([3.0, 0.0])
    assert (
        method._penalties(points, changed, target)["segmentation"] != before["segmentation"]
    ).all()


def perfect(method: NpcsEpn, points: Tensor, target: Target):
    """An answer that says of every point what is so."""
    assert target.part.min() >= 0
    part = torch.nn.functional.one_hot(target.part, 2).float()
    own = target.pose.inverse()[:, None].expand(-1, points.shape[1], -1, -1, -1)
    place = (own[..., :3, :3] @ points[:, :, None, :, None])[..., 0] + own[..., :3, 3]
    near = nearby(points, target.part, target, LAPTOP, method.config.reach)
    turn = own.take_along_dim(target.part[..., None, None, None], 2)[:, :, 0, :3, :3]
    joint = torch.nn.functional.one_hot(near.joint, 2).float()
    return type(method.network(points, points))(
        part=20 * part,
        coordinate=(place - method.box_centre) / method.box_size[:, None] + 0.5,
        joint=20 * joint,
        heat=near.heat,
        towards=(turn @ near.towards[..., None])[..., 0],
        axis=(turn @ near.axis[..., None])[..., 0],
    )


def test_the_truth_costs_nothing_in_either_order() -> None:
    observation, labels = plates(3, 200, seed=5)
    method = made().eval()
    method.start("learn", observation, labels, generator(0))
    points, target = method._normalised(observation, labels)
    assert labels.part is not None
    assert LAPTOP.symmetry is not None
    other = exchanged(target, torch.tensor(LAPTOP.symmetry).float())
    for one in (target, other):
        answer = perfect(method, points, one)
        terms = method._penalties(points, answer, one)
        assert all(float(value.max()) < 0.03 for value in terms.values())
        wrong = method._penalties(points, answer, other if one is target else target)
        assert float(wrong["segmentation"].min()) > 1
        assert answer.coordinate.min() > 0
        assert answer.coordinate.max() < 1


def test_looks_in_another_order_are_brought_to_the_first() -> None:
    """A true answer in one order becomes the true answer in the other, cloud by cloud."""
    observation, labels = plates(3, 200, seed=5)
    method = made().eval()
    method.start("learn", observation, labels, generator(0))
    points, target = method._normalised(observation, labels)
    other = exchanged(target, torch.tensor(LAPTOP.symmetry).float())
    here, there = (perfect(method, points, one) for one in (target, other))
    for first, look in ((here, there), (there, here), (here, here)):
        brought = method._as_first(first, look)
        for name in ("part", "coordinate", "joint", "heat", "towards", "axis"):
            assert_close(getattr(brought, name), getattr(first, name), atol=1e-4, rtol=0)
    as_they_are = made(replace(TINY, either_order=False))._as_first(here, there)
    assert as_they_are is there


def test_a_prediction_is_the_mean_of_its_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    observation, labels = plates(2, 200, seed=5)
    method = made(replace(TINY, points=32)).eval()  # seven clouds, of which four are asked
    method.start("learn", observation, labels, generator(0))
    points, target = method._normalised(observation, labels)
    truth, seen = perfect(method, points, target), []

    def look(some: Tensor, asked: Tensor):
        seen.append(some)
        assert_close(asked, points)
        sure = 4.0 * len(seen)
        return replace(truth, part=truth.part * sure / 20, heat=truth.heat / len(seen))

    monkeypatch.setattr(method.network, "forward", look)
    mean = method.answer_all(points)
    assert [some.shape[1] for some in seen] == [29, 29, 29, 29]
    assert len(torch.cat(seen, 1)[0].unique(dim=0)) == 4 * 29
    assert_close(mean.heat, truth.heat * (1 + 1 / 2 + 1 / 3 + 1 / 4) / 4)
    share = torch.sigmoid(torch.tensor([4.0, 8.0, 12.0, 16.0])).mean()
    assert_close(mean.part.softmax(-1).amax(-1), share.expand(2, 200), atol=1e-5, rtol=0)
    assert_close(mean.axis, truth.axis)


def test_true_answers_become_true_poses_and_joints() -> None:
    observation, labels = plates(3, 200, seed=5)
    method = made().eval()
    method.start("learn", observation, labels, generator(0))
    points, target = method._normalised(observation, labels)
    answer = perfect(method, points, target)
    for p in range(2):
        pose = method._pose(points, answer, p)
        assert_close(pose.rotation, target.pose[:, p, :3, :3], atol=1e-3, rtol=0)
        assert_close(pose.shift, target.pose[:, p, :3, 3], atol=1e-3, rtol=0)
        assert_close(pose.scale, torch.ones(3), atol=1e-3, rtol=0)
    pivot, axis = method._joints(points, answer, target.pose[..., :3, :3])
    assert_close(axis, target.axis, atol=1e-3, rtol=0)
    assert point_line_distance(pivot, target.pivot, target.axis).max() < 0.01


def test_axes_near_points_by_hand() -> None:
    points = torch.tensor([[[0.5, 0.1, 0.0], [9.0, 0.0, 0.05], [0.0, 3.0, 0.0]]])
    target = Target(
        part=torch.zeros(1, 3, dtype=torch.long),
        pose=torch.eye(4).expand(1, 2, 4, 4),
        pivot=torch.zeros(1, 1, 3),
        axis=torch.tensor([[[1.0, 0.0, 0.0]]]),
    )
    near = nearby(points, target.part, target, LAPTOP, 0.2)
    assert near.joint.tolist() == [[0, 0, 1]]
    assert_close(near.heat, torch.tensor([[0.5, 0.75, 0.0]]))
    assert_close(near.towards[0, :2], torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]))


def test_points_vote_for_joints_of_their_own_part() -> None:
    glasses = CATEGORIES["eyeglasses"]
    pivot = torch.tensor([[[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]])
    target = Target(
        part=torch.tensor([[0, 1, 2]]),
        pose=torch.eye(4).expand(1, 3, 4, 4),
        pivot=pivot,
        axis=torch.tensor([[[0.0, 0.0, 1.0]] * 2]),
    )
    points = torch.tensor([[[0.02, 0.0, 0.0]] * 3])
    assert nearby(points, target.part, target, glasses, 0.2).joint.tolist() == [[0, 0, 1]]


def test_few_points_are_filled_up_with_the_likeliest() -> None:
    logits = torch.zeros(1, 20, 2)
    logits[0, :, 0] = 1.0
    logits[0, 5, 1] = 9.0
    logits[0, 6:13, 1] = torch.linspace(0.9, 0.3, 7)
    assert belonging(logits, 1)[0].nonzero()[:, 0].tolist() == list(range(5, 13))
    assert belonging(logits, 0).sum() == 19


def test_medians_leave_out_what_does_not_count() -> None:
    x = normal(0, 2, 9, 3)
    counts = torch.tensor([[True] * 5 + [False] * 4, [False] * 8 + [True]])
    assert_close(median(x, counts)[0], x[0, :5].median(0).values)
    assert_close(median(x, counts)[1], x[1, 8])


def test_presets_and_variants() -> None:
    paper = NpcsEpn(replace(NpcsEpnConfig(), draws=50), LAPTOP, generator(0))
    assert paper.variant == ""
    assert isinstance(paper.stages()[0].schedule, StepDecay)
    lean = NpcsEpn(replace(cpu_config(), threshold=0.2), LAPTOP, generator(0))
    assert lean.variant == "cpu-threshold=0.2"
    assert isinstance(lean.stages()[0].schedule, HalfCosine)


def test_the_symmetry_is_optional() -> None:
    observation, labels = plates(2, 64)
    either, one = (made(replace(TINY, either_order=on)).eval() for on in (True, False))
    for method in (either, one):
        method.box_centre, method.box_size = torch.zeros(2, 3), torch.full((2,), 1.5)
    least, given = (
        torch.stack(list(method.losses(observation, labels, step()).values())).sum()
        for method in (either, one)
    )
    assert least <= given
