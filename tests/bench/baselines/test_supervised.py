# SPDX-License-Identifier: MIT
"""Heads, targets and losses of the supervised baselines, against the evaluator and plain loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from bench.baselines.answers import (
    Answer,
    Target,
    exchanged,
    mean_pose,
    poses_by_vote,
    states,
)
from bench.baselines.supervised import (
    GROW,
    LearningConfig,
    augmented,
    penalties,
)
from bench.matching import reorder_poses
from bench.metrics import sample_errors
from scapo.categories import CATEGORIES
from scapo.geometry.part_order import joint_order, part_orders
from scapo.geometry.points import normalise
from scapo.geometry.rigid import apply, invert, rigid
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.paper.losses import least_costly
from scapo.types import Observation
from tests.helpers import made
from tests.helpers.hinged import plates
from tests.helpers.strategies import generator, normal, rigid_motions, rotations
from tests.helpers.supervised import lean, target_of


def truth(count: int = 3, points: int = 40, parts: int = 2, seed: int = 0) -> tuple[Tensor, Target]:
    """Normal clouds with any labels."""
    joints = parts - 1
    axis = F.normalize(normal(seed + 3, count, joints, 3), dim=-1)
    return normal(seed, count, points, 3), Target(
        part=torch.randint(-1, parts, (count, points), generator=generator(seed)),
        pose=rigid_motions(seed + 1, count, parts),
        pivot=normal(seed + 2, count, joints, 3),
        axis=axis,
    )


def perfect(points: Tensor, target: Target, *, pooled: bool = False) -> Answer:
    """The answer that the truth asks for."""
    parts = target.pose.shape[1]
    base = invert(target.pose[:, 0])
    axis = target.axis @ base[:, :3, :3].mT
    pivot = apply(base, target.pivot)
    votes = torch.stack([apply(invert(target.pose[:, p]), points) for p in range(parts)], 2)
    return Answer(
        part=50.0 * F.one_hot(target.part.clamp(min=0), parts).to(points.dtype),
        votes=None if pooled else votes,
        pose=target.pose if pooled else None,
        pivot=pivot - (pivot * axis).sum(-1, keepdim=True) * axis,
        axis=3 * axis,
    )


@pytest.mark.parametrize("pooled", [False, True])
def test_the_truth_costs_nothing_and_what_is_off_costs(pooled: bool) -> None:
    points, target = truth()
    config, answer = LearningConfig(), perfect(points, target, pooled=pooled)
    right = penalties(points, answer, target, config)
    # Distances of votes are smooth within a hundredth.
    assert all(0 <= float(term.max()) < (0.051 if name == "votes" else 1e-6)
               for name, term in right.items())  # fmt: skip
    turn = rigid(rotations(7), torch.full((3,), 0.3, dtype=torch.float64))
    off = replace(
        answer,
        part=answer.part.flip(-1),
        votes=None if answer.votes is None else answer.votes + 0.3,
        pose=None if answer.pose is None else answer.pose @ turn,
        pivot=answer.pivot + 0.3,
        axis=-answer.axis,
    )
    wrong = penalties(points, off, target, config)
    assert set(wrong) == set(right)
    assert all(float((wrong[name] - right[name]).min()) > 0.1 for name in right)
    assert_close(wrong["axis"], torch.full((3,), 2.0, dtype=torch.float64))


def test_the_segmentation_and_vote_terms_are_means_over_known_points() -> None:
    points, target = truth(count=2)
    config = LearningConfig(segmentation_weight=2.0, pose_weight=3.0)
    answer = replace(
        perfect(points, target), part=normal(4, 2, 40, 2), votes=normal(5, 2, 40, 2, 3)
    )
    assert answer.votes is not None
    terms = penalties(points, answer, target, config)
    for b in range(2):
        entropies, offs = [], []
        for n in range(40):
            label = int(target.part[b, n])
            if label < 0:
                continue
            entropies.append(-float(answer.part[b, n].log_softmax(0)[label]))
            for p in range(2):
                pose = target.pose[b, p]
                own = pose[:3, :3].T @ (points[b, n] - pose[:3, 3])
                offs.append(float(((own - answer.votes[b, n, p]).square().sum() + 1e-4).sqrt()))
        assert 0 < len(entropies) < 40
        assert float(terms["segmentation"][b]) == pytest.approx(2 * np.mean(entropies))
        assert float(terms["votes"][b]) == pytest.approx(3 * np.mean(offs))


@pytest.mark.parametrize("category", ["laptop", "eyeglasses", "basket", "scissors"])
def test_exchanged_truth_is_what_the_evaluator_accepts(category: str) -> None:
    symmetry = CATEGORIES[category].symmetry
    parts = len(CATEGORIES[category].parts)
    _, target = truth(parts=parts)
    other = exchanged(target, torch.tensor(symmetry, dtype=torch.float64))
    order = np.repeat(part_orders(parts)[1:2], 3, 0)
    assert_close(
        other.pose.numpy(),
        reorder_poses(target.pose.numpy(), order, np.array(symmetry)),
    )
    joint = joint_order(order)
    assert_close(
        other.pivot, target.pivot.gather(1, torch.tensor(joint)[..., None].expand(-1, -1, 3))
    )
    for slot in range(parts):
        assert torch.equal(other.part == slot, target.part == int(order[0, slot]))
    assert torch.equal(other.part < 0, target.part < 0)


def test_the_exchanged_joint_opens_the_same_way() -> None:
    """A laptop that stands on its screen is open by as much, and in no direction of its own."""
    observation, labels = plates(6, 50)
    target, _ = target_of(observation, labels)
    symmetry = torch.tensor(CATEGORIES["laptop"].symmetry, dtype=torch.float32)
    other = exchanged(target, symmetry)
    for one in (target, other):
        axis = one.axis @ invert(one.pose[:, 0])[:, :3, :3].mT
        assert labels.joints is not None
        found = states(one.pose, axis, CATEGORIES["laptop"], torch.ones(len(axis)))
        assert_close(found, labels.joints.state, atol=1e-4, rtol=0)


def test_each_cloud_takes_the_cheaper_order() -> None:
    points, target = truth(count=4)
    symmetry = torch.tensor(CATEGORIES["laptop"].symmetry, dtype=torch.float64)
    other = exchanged(target, symmetry)
    one, two = perfect(points, target), perfect(points, other)
    mixed = Answer(
        **{
            name: torch.cat([getattr(one, name)[:2], getattr(two, name)[2:]])
            for name in ("part", "votes", "pivot", "axis")
        },
        pose=None,
    )
    config = LearningConfig()
    both = [penalties(points, mixed, some, config) for some in (target, other)]
    cost = least_costly(both)
    assert float(torch.stack(list(cost.values())).sum()) < 0.06
    alone = least_costly(both[:1])
    totals = [sum(float(term[b]) for term in both[0].values()) for b in range(4)]
    assert float(torch.stack(list(alone.values())).sum()) == pytest.approx(np.mean(totals))


def test_votes_make_poses_that_bad_votes_do_not_spoil() -> None:
    points, target = truth(count=3, points=200)
    votes = perfect(points, target).votes
    assert votes is not None
    weight = torch.ones(3, 200, 2, dtype=torch.float64)
    assert_close(poses_by_vote(points, votes, weight), target.pose, atol=1e-6, rtol=0)
    votes[:, :40] += 2.0
    found = poses_by_vote(points, votes, weight)
    assert (found - target.pose).abs().max() < 0.02
    weight[:, :40] = 0
    assert_close(poses_by_vote(points, votes, weight), target.pose, atol=1e-6, rtol=0)


def test_the_mean_of_poses_about_one_is_that_one() -> None:
    pose = rigid_motions(0, 3)
    turn = rotvec_to_rotmat(0.3 * normal(5, 3))
    sides = [rigid(pose[:, :3, :3] @ t, pose[:, :3, 3]) for t in (turn, turn.mT)]
    assert_close(mean_pose(torch.stack(sides)), pose)


@pytest.mark.parametrize("category", ["laptop", "drawer", "eyeglasses"])
def test_states_are_those_of_the_data(category: str) -> None:
    arrays = made.sample_arrays(category, 6, 20)
    pose = torch.from_numpy(arrays["camera_T_part"])
    base = invert(pose[:, 0])[:, :3, :3]
    axis = torch.from_numpy(arrays["joint_axis"]) @ base.mT
    found = states(pose, axis, CATEGORIES[category], torch.ones(6))
    assert_close(found, torch.from_numpy(arrays["joint_state"]), atol=1e-4, rtol=0)


def test_augmentation_moves_truth_and_cloud_alike() -> None:
    observation, labels = plates(6, 60)
    target, points = target_of(observation, labels)
    config = LearningConfig(rotated=1.0, noisy=0.0, points=40)
    moved, other = augmented(points, target, config, generator(0))
    assert moved.shape == (6, 40, 3)
    for p in range(2):
        before = apply(invert(target.pose[:, p]), points)
        after = apply(invert(other.pose[:, p]), moved)
        gap = torch.cdist(after, before)  # each is one of the points, with its label
        assert gap.amin(-1).max() < 1e-3
        assert torch.equal(target.part.gather(1, gap.argmin(-1)), other.part)
    base = invert(target.pose[:, 0]), invert(other.pose[:, 0])
    assert_close(apply(base[1], other.pivot), apply(base[0], target.pivot), atol=1e-4, rtol=0)
    assert_close(other.axis @ base[1][:, :3, :3].mT, target.axis @ base[0][:, :3, :3].mT)
    turned = [augmented(points, target, replace(config, rotated=share, noisy=share, noise=0.1,
                                                points=None), generator(0))[0]
              for share in (0.0, 0.5)]  # fmt: skip
    assert torch.equal(turned[0], points)
    same = (turned[1] == points).all(-1).all(-1)
    assert 0 < int(same.sum()) < 6


@pytest.mark.parametrize("category", ["laptop", "drawer", "eyeglasses"])
def test_a_perfect_network_predicts_the_truth_in_metres(
    category: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = {name: torch.from_numpy(array) for name, array in
              made.sample_arrays(category, 4, 90, background=9).items()}  # fmt: skip
    method = lean("gcn3d", category).eval()
    normalised, similarity = normalise(arrays["points"])
    pose = arrays["camera_T_part"].clone()
    pose[..., :3, 3] = GROW * similarity.forward(pose[..., :3, 3])
    part = arrays["part"].long()
    target = Target(
        part=torch.where(part == 255, -1, part),
        pose=pose,
        pivot=GROW * similarity.forward(arrays["joint_pivot"]),
        axis=arrays["joint_axis"],
    )
    answer = perfect(GROW * normalised, target)
    monkeypatch.setattr(method, "answer_all", lambda points: answer)
    prediction = method.predict(Observation(points=arrays["points"]))
    assert prediction.camera_T_part is not None
    assert prediction.joints is not None
    errors = sample_errors(
        part_true=target.part.numpy(),
        camera_T_part_true=arrays["camera_T_part"].numpy(),
        pivot_true=arrays["joint_pivot"].numpy(),
        axis_true=arrays["joint_axis"].numpy(),
        part_pred=prediction.part_weight.numpy(),
        camera_T_part_pred=prediction.camera_T_part.numpy(),
        pivot_pred=prediction.joints.pivot.numpy(),
        axis_pred=prediction.joints.axis.numpy(),
    )
    assert errors.pop("iou").min() == 1
    errors.pop("order")
    assert max(value.max() for value in errors.values()) < 1e-2  # degrees and metres
    assert_close(prediction.joints.state, arrays["joint_state"], atol=1e-3, rtol=0)


@pytest.mark.parametrize("pooled", [False, True])
@pytest.mark.parametrize("category", ["laptop", "eyeglasses"])
def test_all_hands_of_a_cloud_name_the_parts_alike(
    category: str, pooled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each hand is answered perfectly, but the second in the other order of the parts."""
    arrays = {name: torch.from_numpy(array).double() for name, array in
              made.sample_arrays(category, 3, 90, background=0).items()}  # fmt: skip
    points, method = arrays["points"], lean("gcn3d", category, points=30).eval()
    truth = Target(
        part=arrays["part"].long(),
        pose=arrays["camera_T_part"],
        pivot=arrays["joint_pivot"],
        axis=arrays["joint_axis"],
    )
    other = exchanged(truth, points.new_tensor(method.category.symmetry))
    told = iter([truth, other, truth])
    hand = iter(range(3))

    def answer(some: Tensor, generator: torch.Generator | None) -> Answer:
        assert generator is None
        target = next(told)
        target = replace(target, part=target.part[:, next(hand) :: 3])
        return perfect(some, target, pooled=pooled)

    monkeypatch.setattr(method, "answer", answer)
    found, right = method.answer_all(points), perfect(points, truth, pooled=pooled)
    assert torch.equal(found.part, right.part)
    assert_close(found.pivot, right.pivot)
    assert_close(found.axis, right.axis / 3)
    for one, true in ((found.votes, right.votes), (found.pose, right.pose)):
        assert (one is None) == (true is None)
        if one is not None:
            assert_close(one, true)
