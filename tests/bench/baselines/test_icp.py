# SPDX-License-Identifier: MIT
"""ICP finds what it has seen, needs labels where it says so, and survives the disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from bench.baselines.icp import Icp, IcpConfig
from bench.baselines.registration import Target, thin
from scapo.categories import CATEGORIES
from scapo.geometry.rigid import apply, axis_angle, point_line_distance, rotation_angle
from scapo.records import take
from scapo.store.checkpoint import load_arrays, to_arrays
from scapo.types import Joints, Labels, Observation, Prediction
from tests.helpers.objects import objects
from tests.helpers.strategies import generator, rigid_motions

SEEN = objects(2, 10, seed=3)
CONFIG = IcpConfig(templates=2, states=2, part_points=400, starts=20)
ROWS = torch.tensor([1, 4, 12, 15])


def started(config: IcpConfig = CONFIG, category: str = "oven") -> Icp:
    method = Icp(config, CATEGORIES[category], generator(0))
    method.start("", SEEN.observation, SEEN.labels.keep(method.supervision), generator(1))
    return method


@pytest.fixture(scope="module")
def icp() -> Icp:
    return started()


def moved(seed: int) -> tuple[Observation, Labels, Joints]:
    """Training clouds under other poses."""
    observation, labels = take((SEEN.observation, SEEN.labels), ROWS)
    motion = rigid_motions(seed, len(ROWS), dtype=torch.float32)
    assert labels.camera_T_part is not None
    assert labels.joints is not None
    joints = replace(
        labels.joints,
        pivot=apply(motion, labels.joints.pivot),
        axis=labels.joints.axis @ motion[:, :3, :3].mT,
    )
    poses = motion[:, None] @ labels.camera_T_part
    points = apply(motion, observation.points)
    return Observation(points=points), replace(labels, camera_T_part=poses, joints=joints), joints


def angles(found: Prediction, labels: Labels) -> torch.Tensor:
    """(B, P) degrees between found and true part rotations."""
    assert found.camera_T_part is not None
    assert labels.camera_T_part is not None
    turns = found.camera_T_part[..., :3, :3], labels.camera_T_part[..., :3, :3]
    return rotation_angle(*turns).rad2deg()


def test_a_training_object_is_found_again_whatever_its_pose(icp: Icp) -> None:
    observation, labels, joints = moved(5)
    found = icp.predict(observation)
    assert labels.part is not None
    assert labels.camera_T_part is not None
    assert found.camera_T_part is not None
    assert (found.part_weight.argmax(-1) == labels.part).float().mean() > 0.93
    assert angles(found, labels).median() < 5
    gap = found.camera_T_part[..., :3, 3] - labels.camera_T_part[..., :3, 3]
    assert gap.norm(dim=-1).median() < 0.05
    assert found.joints is not None
    assert axis_angle(found.joints.axis, joints.axis).rad2deg().median() < 5
    away = point_line_distance(found.joints.pivot, joints.pivot, joints.axis)
    assert away.median() < 0.05
    assert (found.joints.state - joints.state).abs().median() < 0.1


def test_true_parts_are_used_and_background_is_not(icp: Icp) -> None:
    observation, labels, _ = moved(6)
    assert labels.part is not None
    given = labels.part.clone()
    given[:, :10] = -1
    found = icp.predict_given(observation, Labels(part=given))
    assert torch.equal(found.part_weight.argmax(-1)[:, 10:], given[:, 10:])
    assert angles(found, labels)[:, 0].median() < 5
    with pytest.raises(ValueError, match="icp: expected true parts, found none"):
        icp.predict_given(observation, Labels())


def test_parts_are_registered_on_their_own_when_they_are_given(icp: Icp) -> None:
    observation, labels, _ = moved(6)
    assert labels.part is not None
    apart = observation.points + 5.0 * (labels.part == 1)[..., None]  # no whole fits any more
    found = icp.predict_given(Observation(points=apart), Labels(part=labels.part))
    assert found.camera_T_part is not None
    assert bool(torch.isfinite(found.camera_T_part).all())
    gap = found.camera_T_part[:, 1, :3, 3] - found.camera_T_part[:, 0, :3, 3]
    assert (gap.norm(dim=-1) > 4).all()


def test_a_part_that_is_not_seen_keeps_the_whole_pose(icp: Icp) -> None:
    observation, labels, _ = moved(7)
    assert labels.part is not None
    found = icp.predict_given(observation, Labels(part=torch.zeros_like(labels.part)))
    assert found.camera_T_part is not None
    assert bool(torch.isfinite(found.camera_T_part).all())


def test_scale_does_not_matter(icp: Icp) -> None:
    observation, _, _ = moved(8)
    once = icp.predict(observation)
    twice = icp.predict(Observation(points=2 * observation.points))
    assert once.camera_T_part is not None
    assert twice.camera_T_part is not None
    assert_close(twice.part_weight, once.part_weight)
    turns = twice.camera_T_part[..., :3, :3], once.camera_T_part[..., :3, :3]
    assert_close(*turns, atol=1e-3, rtol=0)


def test_sliding_states_are_lengths() -> None:
    seen = objects(2, 8, kind="prismatic", seed=4)
    method = Icp(CONFIG, CATEGORIES["drawer"], generator(0))
    method.start("", seen.observation, seen.labels.keep(method.supervision), generator(1))
    some, labels = take((seen.observation, seen.labels), torch.tensor([2, 11]))
    found = method.predict(some).joints
    assert found is not None
    assert labels.joints is not None
    assert (found.state - labels.joints.state).abs().max() < 0.03
    assert axis_angle(found.axis, labels.joints.axis).rad2deg().max() < 5


def test_it_declares_the_labels_it_needs() -> None:
    method = Icp(CONFIG, CATEGORIES["oven"], generator(0))
    assert method.supervision == {"segmentation", "pose", "joint", "instance"}
    assert method.oracle == {"segmentation"}
    assert method.stages() == ()
    assert method.variant == ""
    for name in method.supervision:
        less = SEEN.labels.keep(method.supervision - {name})
        with pytest.raises(ValueError, match="found some withheld"):
            method.start("", SEEN.observation, less, generator(0))
    few = Icp(replace(CONFIG, templates=3), CATEGORIES["oven"], generator(0))
    with pytest.raises(ValueError, match=r"expected at least 3 training objects .*, found 2"):
        few.start("", SEEN.observation, SEEN.labels, generator(0))


def test_templates_come_back_from_disk(icp: Icp) -> None:
    other = Icp(replace(CONFIG, templates=4), CATEGORIES["oven"], generator(9))
    load_arrays(other, to_arrays(icp), Path("memory"))
    assert torch.equal(other.template_points, icp.template_points)
    observation, _, _ = moved(5)
    one = take(observation, torch.tensor([0]))
    assert_close(other.predict(one).camera_T_part, icp.predict(one).camera_T_part)


def test_distances_are_capped_at_the_reach() -> None:
    target = Target(0, 0, np.zeros((9, 3)) + np.arange(9)[:, None])
    points = np.array([[0.0, 0.0, 0.1], [9.0, 9.0, 9.0]])
    assert target.squares(points, 0.5).tolist() == pytest.approx([0.01, 0.25])
    assert target.centre[0] == pytest.approx(4.0)


def test_thin_keeps_at_least_the_count() -> None:
    points = np.zeros((100, 3))
    assert len(thin(points, 30)) == 34
    assert len(thin(points, 200)) == 100
