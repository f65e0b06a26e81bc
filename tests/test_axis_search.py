# SPDX-License-Identifier: MIT
"""Candidate joints: the true axis wins among the main directions, near its true place."""

from __future__ import annotations

from dataclasses import replace

import roma
import torch
from sighted import AXIS, PIVOT, sighted, template
from strategies import generator
from torch.testing import assert_close

from scapo.axis_search import (
    Posed,
    along_main_directions,
    principal_frame,
    search_joint,
    still_evidence,
)
from scapo.geometry import point_line_distance, random_rotations
from scapo.registration import rotation_grid
from scapo.template import Placement


def posed(count: int, seed: int) -> Posed:
    views, truth = sighted(count, seed=seed)
    return Posed(views=views, rotation=truth.rotation, translation=truth.translation)


def test_the_true_axis_wins():
    scene = posed(24, 30)
    evidence = still_evidence(scene)
    moved = evidence < evidence.flatten().quantile(0.25)
    guesses = search_joint(scene, moved, "revolute", torch.eye(3), generator=generator(0))
    assert [guess.score for guess in guesses] == sorted((g.score for g in guesses), reverse=True)
    assert torch.equal(guesses[0].axis, AXIS)
    assert point_line_distance(guesses[0].pivot, PIVOT, AXIS) < 0.12


def test_moved_points_are_those_of_the_flap():
    scene = posed(16, 31)
    points, _ = scene.world(128)
    evidence = still_evidence(scene)
    box = ((points - torch.tensor([0.0, 0, 0])).abs() < torch.tensor([0.21, 0.3, 0.16])).all(-1)
    assert evidence[box].mean() > evidence[~box].mean() + 0.3


def test_the_frame_follows_most_normals():
    turn = random_rotations(1, generator(1))[0]
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).repeat(20, 1)
    noise = 0.05 * torch.randn(120, 3, generator=generator(2))
    frame = principal_frame(
        torch.nn.functional.normalize(axes @ turn.T + noise, dim=-1), rotation_grid(1500)
    )
    aligned = (frame @ turn).abs()
    assert aligned.amax(1).min() > 0.995
    assert torch.allclose(torch.linalg.det(frame), torch.tensor(1.0), atol=1e-4)


@torch.no_grad()
def test_the_frame_turns_back_to_the_main_directions_of_the_base():
    shape, start = (
        template(),
        Placement.at(random_rotations(3, generator(1)), torch.zeros(3, 3), torch.zeros(3, 1)),
    )
    before, _ = shape.place(start)
    lean = roma.rotvec_to_rotmat(torch.tensor([0.15, -0.1, 0.2]))
    for vectors in (shape.points, shape.normals, shape.axis, shape.pivot):
        vectors.copy_(vectors @ lean.T)
    leant = replace(start, rotation=start.rotation @ lean.T)
    found = along_main_directions(shape, leant)
    assert_close(found.rotation, start.rotation, atol=2e-3, rtol=0)
    assert_close(shape.directions()[0], AXIS, atol=2e-3, rtol=0)
    assert_close(shape.place(found)[0], before, atol=1e-4, rtol=0)
