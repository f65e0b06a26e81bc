# SPDX-License-Identifier: MIT
"""ICP finds what it has seen, needs labels where it says so, and survives the disk."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from bench.baselines.icp import Icp, IcpConfig, Target, thin
from bench.matching import rotation_degrees
from scapo.categories import CATEGORIES
from scapo.geometry.rigid import apply
from scapo.store.checkpoint import load_arrays, to_arrays
from scapo.types import Labels, Observation
from tests.helpers.hinged import plates
from tests.helpers.strategies import generator, rigid_motions


def bumped(count: int, seed: int) -> tuple[Observation, Labels]:
    """Plates with a peg on the base, so that no half turn fits."""
    observation, labels = plates(count, 400, seed)
    assert labels.camera_T_part is not None
    assert labels.part is not None
    peg = 0.02 * torch.randn(count, 60, 3, generator=generator(seed)) + torch.tensor(
        [0.4, 0.4, 0.3]
    )
    there = apply(labels.camera_T_part[:, 0], peg)
    points = torch.cat([observation.points, there], 1)
    part = torch.cat([labels.part, torch.zeros(count, 60, dtype=torch.long)], 1)
    return Observation(points=points), replace(labels, part=part)


@pytest.fixture(scope="module")
def icp() -> Icp:
    method = Icp(IcpConfig(templates=3, starts=40), CATEGORIES["laptop"], generator(0))
    observation, labels = bumped(3, 0)
    method.start("", observation, labels.keep(method.supervision), generator(1))
    return method


def moved(count: int, seed: int) -> tuple[Observation, Labels]:
    """The training clouds under other poses."""
    observation, labels = bumped(3, 0)
    motion = rigid_motions(seed, count, dtype=torch.float32)
    assert labels.camera_T_part is not None
    return (
        Observation(points=apply(motion, observation.points[:count])),
        Labels(
            part=None if labels.part is None else labels.part[:count],
            camera_T_part=motion[:, None] @ labels.camera_T_part[:count],
        ),
    )


def test_a_template_is_found_again_whatever_its_pose(icp: Icp) -> None:
    observation, labels = moved(3, 5)
    prediction = icp.predict(observation)
    assert labels.part is not None
    assert labels.camera_T_part is not None
    assert prediction.camera_T_part is not None
    assert (prediction.part_weight.argmax(-1) == labels.part).float().mean() > 0.99
    found, true = prediction.camera_T_part.numpy(), labels.camera_T_part.numpy()
    assert rotation_degrees(found[..., :3, :3], true[..., :3, :3]).max() < 1
    assert np.abs(found[..., :3, 3] - true[..., :3, 3]).max() < 0.01
    assert prediction.joints is None


def test_given_parts_are_used_and_background_is_not(icp: Icp) -> None:
    observation, labels = moved(2, 6)
    assert labels.part is not None
    given = 1 - labels.part
    given[:, :10] = -1
    prediction = icp.predict_given(observation, Labels(part=given))
    assert torch.equal(prediction.part_weight.argmax(-1)[:, 10:], given[:, 10:])
    with pytest.raises(ValueError, match="expected true parts, found none"):
        icp.predict_given(observation, Labels())


def test_a_part_that_is_not_seen_keeps_the_whole_pose(icp: Icp) -> None:
    observation, labels = moved(1, 7)
    assert labels.part is not None
    prediction = icp.predict_given(observation, Labels(part=torch.zeros_like(labels.part)))
    assert prediction.camera_T_part is not None
    assert bool(torch.isfinite(prediction.camera_T_part).all())


def test_scale_does_not_matter(icp: Icp) -> None:
    observation, _ = moved(1, 8)
    once = icp.predict(observation)
    twice = icp.predict(Observation(points=2 * observation.points))
    assert once.camera_T_part is not None
    assert twice.camera_T_part is not None
    assert_close(twice.part_weight, once.part_weight)
    assert_close(
        twice.camera_T_part[..., :3, :3], once.camera_T_part[..., :3, :3], atol=1e-3, rtol=0
    )


def test_it_declares_the_labels_it_needs() -> None:
    method = Icp(IcpConfig(templates=3), CATEGORIES["laptop"], generator(0))
    assert method.supervision == {"segmentation", "pose"}
    assert method.oracle == {"segmentation"}
    assert method.stages() == ()
    observation, labels = bumped(3, 0)
    with pytest.raises(ValueError, match="expected at least 3 labelled clouds, found 3"):
        method.start("", observation, labels.keep(frozenset({"segmentation"})), generator(0))
    few = Observation(points=observation.points[:2])
    with pytest.raises(ValueError, match="expected at least 3 labelled clouds, found 2"):
        method.start("", few, labels, generator(0))


def test_templates_come_back_from_disk(icp: Icp) -> None:
    other = Icp(IcpConfig(templates=3), CATEGORIES["laptop"], generator(9))
    load_arrays(other, to_arrays(icp), Path("memory"))
    assert torch.equal(other.template_points, icp.template_points)
    assert torch.equal(other.template_part, icp.template_part)
    observation, _ = moved(1, 5)
    assert_close(other.predict(observation).camera_T_part, icp.predict(observation).camera_T_part)


def test_distances_are_capped_at_the_reach() -> None:
    target = Target(0, np.zeros((9, 3)) + np.arange(9)[:, None])
    points = np.array([[0.0, 0.0, 0.1], [9.0, 9.0, 9.0]])
    assert target.squares(points, 0.5).tolist() == pytest.approx([0.01, 0.25])
    assert math.isclose(target.centre[0], 4.0)


def test_thin_keeps_at_least_the_count() -> None:
    points = np.zeros((100, 3))
    assert len(thin(points, 30)) == 34
    assert len(thin(points, 200)) == 100
