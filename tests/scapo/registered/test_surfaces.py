# SPDX-License-Identifier: MIT
"""Whole boxes with a flap, shown from all sides to a run that knows only some of them."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from scapo.geometry.points import Similarity, normalise
from scapo.geometry.rigid import point_line_distance, random_rotations, rotation_angle
from scapo.records import take
from scapo.registered.surfaces import SIDES, lying, misfit, seen
from scapo.registered.template import Placement
from scapo.types import Observation
from tests.helpers.sighted import template
from tests.helpers.strategies import generator, normal

COUNT = 4
BESIDE = torch.tensor([0.0, 0.03, -0.05])
"""Of an object's own hinge from the template's, in the template's size."""


class Sighted:
    """Knows how surfaces lie when it sees them from the front; else it says anything."""

    def __init__(self, truth: Placement, grown: float = 1.0) -> None:
        """Of the sizes it says so many times too much."""
        self.truth, self.grown, self.answers = truth, math.log(grown), 0

    def __call__(self, observation: Observation) -> tuple[Placement, Tensor, Similarity]:
        points, similarity = normalise(observation.points)
        assert points.shape[1] == 384
        assert observation.sensor is not None
        front = (self.truth.rotation.mT @ observation.sensor[..., None])[:, 0, 0] < 0
        rotation = random_rotations(COUNT, generator(self.answers))
        self.answers += 1
        rotation = torch.where(front[:, None, None], self.truth.rotation, rotation)
        state = torch.where(front[:, None], self.truth.state + 0.2, 0.0)
        away, size = self.truth.translation - similarity.centre, similarity.scale[:, None]
        said = Placement.at(rotation, away * size, state)
        said.log_scale.add_(size.log() + self.grown)
        hinge = (template().pivot.detach() + BESIDE) * said.log_scale.exp()[:, None]
        return replace(said, pivot=hinge), torch.where(front, 0.9, 0.5), similarity


def surfaces() -> tuple[Tensor, Placement]:
    """Normalised, in any pose, and how the template lies in them."""
    clouds, rotation = [], random_rotations(COUNT, generator(1))
    state = torch.tensor([[0.1], [0.4], [0.7], [1.0]])
    truth = Placement.at(rotation, torch.zeros(COUNT, 3), state)
    for k in range(COUNT):
        with torch.no_grad():
            clouds.append(template(k + 5, 1024).place(take(truth, torch.tensor([k])))[0][0])
    points, similarity = normalise(torch.stack(clouds))
    truth = Placement.at(rotation, -similarity.centre * similarity.scale[:, None], state)
    truth.log_scale.add_(similarity.scale.log()[:, None])
    return points, truth


@pytest.mark.parametrize("off", [0.0, 0.03])
def test_sides_that_agree_say_how_the_template_lies(off: float) -> None:
    points, truth = surfaces()
    said = copy.deepcopy(truth)
    said.translation.add_(off)
    ask = Sighted(said)
    found, share = lying(template(), ask, 2.0, points)
    assert ask.answers == SIDES
    assert rotation_angle(found.rotation, truth.rotation).rad2deg().max() < 4
    assert (found.state - truth.state).abs().max() < 0.15  # told off by 0.2
    assert (found.state - truth.state).abs().mean() < 0.1
    assert_close(found.translation, truth.translation, atol=0.02, rtol=0)
    assert 0.3 < share.min() <= share.max() < 1


@pytest.mark.parametrize("grown", [1.0, 1.2])
def test_the_hinge_that_a_side_says_is_that_of_the_surface(grown: float) -> None:
    points, truth = surfaces()
    found, _ = lying(template(), Sighted(truth, grown), 2.0, points)
    pivot, axis = template().joints_in_view(found)
    hinge = (template().pivot.detach() + BESIDE) * truth.log_scale.exp()[:, None]
    wanted = hinge @ truth.rotation.mT + truth.translation[:, None]
    assert point_line_distance(wanted, pivot, axis).max() < 0.02


def test_of_a_ball_a_camera_sees_what_faces_it() -> None:
    ball = F.normalize(normal(0, 3000, 3, dtype=torch.float32), dim=-1) / 4
    camera = torch.tensor([0.6, -0.5, 0.6])
    facing = ((camera - ball) * ball).sum(-1) / 0.25  # 0 at the rim
    shown = seen(ball, camera)
    assert shown[facing > 0.1].float().mean() > 0.95
    assert shown[facing < -0.1].float().mean() < 0.01


def test_a_wall_hides_another() -> None:
    side = torch.linspace(-0.3, 0.3, 24)
    wall = F.pad(torch.cartesian_prod(side, side), (0, 1))
    wall = wall + 0.002 * normal(3, 576, 3, dtype=torch.float32)
    behind = 0.8 * wall + torch.tensor([0.0, 0, 0.2])
    shown = seen(torch.cat([behind, wall]), torch.tensor([0.05, 0.0, -1.0]))
    assert shown[576:].float().mean() > 0.9
    assert shown[:576].float().mean() < 0.1


def test_points_in_one_plane_with_the_camera_are_all_seen() -> None:
    line = F.pad(torch.linspace(-0.3, 0.3, 50)[:, None], (0, 2))
    assert bool(seen(line, torch.tensor([0.0, 1.0, 0.0])).all())


def test_what_the_shape_lacks_costs_no_more_than_far() -> None:
    near = 0.2 * normal(4, 1, 200, 3, dtype=torch.float32)
    assert misfit(near, near).item() < 0.01
    half = misfit(torch.cat([near, near + 5], 1), near).item()
    assert half == pytest.approx(0.04, abs=0.01)  # half of the surface, at most 0.08 each
    assert misfit(near, torch.cat([near, near + 5], 1)).item() > 1
