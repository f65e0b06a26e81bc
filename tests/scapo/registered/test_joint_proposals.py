# SPDX-License-Identifier: MIT
"""Candidate joints: the true axis wins among the main directions, near its true place."""

from __future__ import annotations

from dataclasses import replace

import pytest
import roma
import torch
from torch.testing import assert_close

from scapo.geometry.rigid import point_line_distance, random_rotations
from scapo.registered.joint_proposals import (
    Posed,
    along_main_directions,
    principal_frame,
    search_joint,
    still_evidence,
    tells_frame,
)
from scapo.registered.pairwise import rotation_grid
from scapo.registered.template import ArticulatedTemplate, Placement
from tests.helpers.sighted import AXIS, PIVOT, sighted, template
from tests.helpers.strategies import generator


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
    assert tells_frame(shape)
    assert_close(found.rotation, start.rotation, atol=2e-3, rtol=0)
    assert_close(shape.directions()[0], AXIS, atol=2e-3, rtol=0)
    assert_close(shape.place(found)[0], before, atol=1e-4, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("degrees", [30.0, 45.0])
def test_the_frame_of_a_plate_follows_its_normal_and_its_hinge(degrees: float):
    g = generator(7)
    points = torch.rand(300, 3, generator=g) * torch.tensor([0.6, 0.4, 0.0])
    up = (torch.rand(300, 1, generator=g) < 0.5) * 2.0 - 1
    normals = up * torch.tensor([0.0, 0.0, 1.0]) + 0.05 * torch.randn(300, 3, generator=g)
    plate = ArticulatedTemplate(("revolute",), 300)
    plate.assign(
        points,
        torch.nn.functional.normalize(normals, dim=-1),
        torch.tensor([[8.0, 0.0]]).expand(300, 2),
    )
    plate.axis.copy_(torch.tensor([[0.8, 0.6, 0.0]]))
    turn = roma.rotvec_to_rotmat(torch.deg2rad(torch.tensor([degrees, 0.0, 0.0])))
    for vectors in (plate.points, plate.normals, plate.axis):
        vectors.copy_(vectors @ turn.T)
    start = Placement.at(random_rotations(2, g), torch.zeros(2, 3), torch.zeros(2, 1))
    before, _ = plate.place(start)
    found = along_main_directions(plate, start)
    assert not tells_frame(plate)
    assert plate.normals.abs().mean(0).max() > 0.98
    assert plate.directions()[0].abs().max() > 0.999
    assert_close(plate.place(found)[0], before, atol=1e-4, rtol=0)
