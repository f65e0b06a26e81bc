# SPDX-License-Identifier: MIT
"""The loss of a view is least at the truth; its weight is what the formula says."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from scapo.registered.pose_refinement import BACKWARD, MOVED, backward_weight
from scapo.registered.view_loss import (
    NORMAL_WEIGHT,
    match_weight,
    normal_weight,
    oriented_nearest,
    sharpened,
    should_be_seen,
    view_loss,
)
from scapo.registered.views import observe
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator


@torch.no_grad()
def test_the_loss_is_least_at_the_truth():
    views, truth = sighted(4, seed=10)
    shape = template()
    right = view_loss(views, shape.place(truth), 250.0)
    for wrong in (
        replace(truth, state=truth.state + 0.4),
        replace(truth, translation=truth.translation + 0.1),
        replace(truth, rotation=truth.rotation @ torch.diag(torch.tensor([-1.0, -1.0, 1.0]))),
    ):
        loss = view_loss(views, shape.place(wrong), 250.0)
        assert loss.mean() > right.mean() + 0.05
        assert (loss > right).sum() >= 3  # the flap is edge-on in one view


@torch.no_grad()
def test_what_is_missed_of_a_moving_part_counts_less_but_of_two_like_halves() -> None:
    views, truth = sighted(4, seed=10)
    shape, moves = template(), template().logit.argmax(-1) > 0
    wrong = shape.place(replace(truth, state=truth.state + 0.8))
    whole = view_loss(views, wrong, 250.0, BACKWARD)
    weight = backward_weight(shape)
    assert weight[~moves].unique().tolist() == [BACKWARD]
    assert weight[moves].unique().tolist() == [BACKWARD * MOVED]
    forward = view_loss(views, wrong, 250.0, 0.0)
    body = view_loss(views, wrong, 250.0, BACKWARD * ~moves)
    own = view_loss(views, wrong, 250.0, weight)
    assert_close(own - forward, body - forward + MOVED * (whole - body))
    assert (own < whole).all()
    shape.alike.fill_(1.0)
    assert_close(view_loss(views, wrong, 250.0, backward_weight(shape)), whole)


def test_the_two_faces_of_a_plate_are_told_apart():
    up, point = torch.tensor([[[0.0, 0, 1]]]), torch.zeros(1, 1, 3)
    faces = torch.cat([point, point + torch.tensor([0, 0, 0.01])], 1)
    normals = torch.cat([up, -up], 1)
    assert oriented_nearest(point + 0.004 * up, up, faces, normals).item() == 0
    assert oriented_nearest(point + 0.004 * up, -up, faces, normals).item() == 1


def test_the_weight_of_a_match_by_its_formula():
    off, cosine = torch.tensor([0.0, 0.01, 0.01]), torch.tensor([1.0, 1.0, 0.2])
    expected = [1.0, math.exp(-0.5), math.exp(-0.5 - NORMAL_WEIGHT * 0.8)]
    assert match_weight(off, 50.0, cosine).tolist() == pytest.approx(expected)
    assert match_weight(off, 50.0).tolist() == pytest.approx([1.0, *[math.exp(-0.5)] * 2])
    assert normal_weight(cosine).tolist() == pytest.approx([1, 1, math.exp(-0.8 * NORMAL_WEIGHT)])


def test_sharpness_grows_by_one_factor():
    assert sharpened((50.0, 200.0), 3) == pytest.approx([50.0, 100.0, 200.0])
    assert sharpened((50.0, 200.0), 1) == [50.0]


def test_a_camera_should_see_what_faces_it_and_nothing_hides():
    flat = 0.6 * torch.rand(900, 2, generator=generator(0)) - 0.3
    plate = torch.cat([flat, torch.zeros(900, 1)], -1)[None]
    views = observe(plate, torch.tensor([[0.0, 0.0, 2.0]]))
    points = torch.tensor([[[0.1, 0, 0], [0.1, 0, 0], [0.1, 0, -0.2], [0, 0, 0.2]]])
    normals = torch.tensor([[[0.0, 0, 1], [0, 0, -1], [0, 0, 1], [0, 0, -1]]])
    # on the plate to and from the camera, behind it, and in space that the camera saw empty
    assert should_be_seen(views, points, normals).tolist() == [[True, False, False, True]]
