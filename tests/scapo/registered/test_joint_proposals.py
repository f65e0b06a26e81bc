# SPDX-License-Identifier: MIT
"""Candidate joints: the true axis wins among the main directions, near its true place."""

from __future__ import annotations

import torch

from scapo.geometry.rigid import point_line_distance
from scapo.registered.joint_proposals import PosedViews, candidates, moved_sets, still_evidence
from tests.helpers.sighted import AXIS, PIVOT, sighted
from tests.helpers.strategies import generator


def posed(count: int, seed: int) -> PosedViews:
    views, truth = sighted(count, seed=seed)
    return PosedViews(views=views, rotation=truth.rotation, translation=truth.translation)


def test_the_true_axis_wins():
    scene = posed(24, 30)
    evidence = still_evidence(scene)
    moved = evidence < evidence.flatten().quantile(0.25)
    proposals = candidates(scene, moved, "revolute", torch.eye(3), generator=generator(0))
    scores = [proposal.score for proposal in proposals]
    assert scores == sorted(scores, reverse=True)
    assert torch.equal(proposals[0].axis, AXIS)
    assert point_line_distance(proposals[0].pivot, PIVOT, AXIS) < 0.12


def test_moved_points_are_those_of_the_flap():
    scene = posed(16, 31)
    points, _ = scene.world(128)
    evidence = still_evidence(scene)
    box = ((points - torch.tensor([0.0, 0, 0])).abs() < torch.tensor([0.21, 0.3, 0.16])).all(-1)
    assert evidence[box].mean() > evidence[~box].mean() + 0.3


def test_points_that_no_other_view_confirms_are_shared_among_the_joints():
    scene = posed(12, 3)
    alone = moved_sets(scene, 1, generator(0))[0]
    assert 0.2 < alone.float().mean() < 0.4
    points, _ = scene.world(alone.shape[1])
    flap = (points[..., 0] < -0.22) | (points[..., 2].abs() > 0.17)
    assert flap[alone].float().mean() > 1.5 * flap.float().mean()
    several = moved_sets(scene, 2, generator(0))
    assert not (several[0] & several[1]).any()
    assert torch.equal(several[0] | several[1], alone)
