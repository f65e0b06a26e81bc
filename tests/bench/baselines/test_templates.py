# SPDX-License-Identifier: MIT
"""Fused templates are the objects themselves, whole, in one unit with their views."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from bench.baselines.templates import LEAST_POINTS, FusionConfig, Templates, fuse, spread_states
from scapo.categories import JointKind
from scapo.geometry.points import normalise, squared_distances
from scapo.geometry.rigid import apply, invert, joint_motion, point_line_distance
from scapo.types import Labels
from tests.helpers.objects import Objects, objects
from tests.helpers.sighted import AXIS, PIVOT
from tests.helpers.sliding import OUT
from tests.helpers.strategies import generator

CONFIG = FusionConfig(templates=3, states=3, part_points=256)


def fused(seen: Objects, seed: int = 0, config: FusionConfig = CONFIG) -> Templates:
    return fuse(seen.observation, seen.labels, config, generator(seed))


def scales(seen: Objects, views: int) -> torch.Tensor:
    """Median scale that `normalise` gives the clouds of each object."""
    return normalise(seen.observation.points)[1].scale.view(-1, views).median(1).values


def which(made: Templates, seen: Objects, views: int) -> list[int]:
    """The object of each template, told by where its hinge is."""
    hinges = PIVOT * seen.stretch * scales(seen, views)[:, None]
    gap = point_line_distance(made.pivot, hinges, AXIS.expand_as(hinges))
    assert gap.amin(1).max() < 1e-4
    return gap.argmin(1).tolist()


def test_a_template_is_the_whole_object_part_by_part() -> None:
    seen = objects(3, 12)
    made = fused(seen)
    assert made.points.shape == (3, 2, 256, 3)
    objects_of = which(made, seen, 12)
    assert sorted(objects_of) == [0, 1, 2]
    assert seen.labels.part is not None
    assert seen.labels.camera_T_part is not None
    for cloud, k in zip(made.points, objects_of, strict=True):
        rest, part = seen.surfaces[k]
        for p in (0, 1):
            true = rest[part == p] * scales(seen, 12)[k]
            assert squared_distances(cloud[p], true).max() < 1e-8  # each a point of the object
            for b in range(12 * k, 12 * k + 12):  # and all that any view shows is near one
                shown = seen.observation.points[b, seen.labels.part[b] == p]
                shown = apply(invert(seen.labels.camera_T_part[b, p]), shown) * scales(seen, 12)[k]
                assert squared_distances(shown, cloud[p]).max().sqrt() < 0.08


def test_whole_templates_are_the_object_in_states_it_was_seen_in() -> None:
    seen = objects(3, 12)
    made = fused(seen)
    assert seen.labels.joints is not None
    states = seen.labels.joints.state.view(3, 12)
    whole = made.whole().unflatten(2, (2, 256))
    for t, k in enumerate(which(made, seen, 12)):
        pivot = PIVOT * seen.stretch[k] * scales(seen, 12)[k]
        gaps = []
        for s in range(3):
            assert_close(whole[t, s, 0], made.points[t, 0])
            posed = [apply(joint_motion(pivot, AXIS, a, "revolute"), made.points[t, 1])
                     for a in states[k]]  # fmt: skip
            off = torch.stack([(one - whole[t, s, 1]).norm(dim=-1).max() for one in posed])
            assert off.min() < 1e-4
            gaps.append(states[k][off.argmin()])
        spread = torch.stack(gaps).max() - torch.stack(gaps).min()
        assert spread > 0.4 * (states[k].max() - states[k].min())


@pytest.mark.parametrize(("kind", "axis"), [("revolute", AXIS), ("prismatic", OUT)])
def test_joints_are_known_in_the_frame_of_the_base(kind: JointKind, axis: torch.Tensor) -> None:
    made = fused(objects(3, 6, kind=kind))
    assert_close(made.axis, axis.expand(3, 1, 3), atol=1e-5, rtol=0)


def test_the_seed_draws_different_objects() -> None:
    seen = objects(6, 4)
    two = replace(CONFIG, templates=2)
    drawn = [tuple(which(fused(seen, seed, two), seen, 4)) for seed in range(6)]
    assert all(len(set(pair)) == 2 for pair in drawn)
    assert len(set(drawn)) > 1
    assert_close(fused(seen, 3, two).points, fused(seen, 3, two).points)


def test_objects_that_show_no_part_are_left_out() -> None:
    seen = objects(4, 3)
    assert seen.labels.part is not None
    assert seen.labels.instance is not None
    part = seen.labels.part.clone()
    hidden = seen.labels.instance == 11
    part[hidden] = torch.where(part[hidden] == 1, -1, part[hidden])
    part[3, : LEAST_POINTS - 1] = 1
    labels = replace(seen.labels, part=part)
    made = fuse(seen.observation, labels, CONFIG, generator(0))
    assert sorted(which(made, seen, 3)) == [0, 2, 3]
    more = replace(CONFIG, templates=4)
    words = r"expected at least 4 training objects .* show every part \(--templates\), found 3"
    with pytest.raises(ValueError, match=words):
        fuse(seen.observation, labels, more, generator(0))


@pytest.mark.parametrize("name", ["part", "camera_T_part", "joints", "instance"])
def test_all_labels_are_needed(name: str) -> None:
    seen = objects(3, 2)
    labels = replace(seen.labels, **{name: None})
    with pytest.raises(ValueError, match="expected parts, poses, joints and objects, found some"):
        fuse(seen.observation, labels, CONFIG, generator(0))
    with pytest.raises(ValueError, match="found some withheld"):
        fuse(seen.observation, Labels(), CONFIG, generator(0))


def test_few_points_and_states_are_repeated() -> None:
    made = fused(objects(3, 2, points=40), config=replace(CONFIG, states=5))
    assert made.base_T_part.shape == (3, 5, 2, 4, 4)
    assert made.points.shape == (3, 2, 256, 3)
    assert bool(torch.isfinite(made.points).all())


def test_states_are_those_nearest_to_centres() -> None:
    feature = torch.tensor([[0.0], [0.1], [0.2], [1.0], [1.1], [1.2], [2.0], [2.1], [2.2]])
    assert sorted(spread_states(feature, 3).tolist()) == [1, 4, 7]
    assert spread_states(feature[:1], 2).tolist() == [0, 0]
