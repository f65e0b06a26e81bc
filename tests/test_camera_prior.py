# SPDX-License-Identifier: MIT
"""Of poses that explain a view alike, that one is taken whose camera stands where others do."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from sighted import sighted
from strategies import generator
from torch.testing import assert_close

from scapo.camera_prior import (
    ALIKE,
    CONCENTRATION,
    FLOOR,
    WEIGHT,
    CameraPrior,
    agreed,
    directions,
)
from scapo.geometry import random_rotations
from scapo.pose_search import Finalists
from scapo.state_range import StateRange
from scapo.template import Placement

OVER = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
"""Half a turn about x."""
ANY = StateRange(low=torch.tensor([-9.0]), high=torch.tensor([9.0]), unit=torch.ones(1))


def test_the_density_decides_between_losses_that_are_alike() -> None:
    g = generator(2)
    views, truth = sighted(30, seed=4)
    cameras = F.normalize(torch.randn(7, 3, generator=g), dim=-1)
    drawn = [truth, *(Placement.at(random_rotations(30, g), truth.translation, truth.state),) * 3]
    placement = Placement.cat(drawn).take(torch.arange(120).view(4, 30).T.flatten())
    loss = 0.3 * torch.rand(30, 4, generator=g)
    finalists = Finalists(placement=placement, loss=loss)
    angle = (directions(finalists, views)[:, :, None] * cameras).sum(-1).arccos()
    norm = CONCENTRATION / (4 * math.pi * math.sinh(CONCENTRATION))  # von Mises-Fisher in 3-D
    density = (norm * torch.exp(CONCENTRATION * angle.cos())).mean(-1) * 4 * math.pi
    total = loss - WEIGHT * (FLOOR + (1 - FLOOR) * density).log()
    total[loss > loss.amin(1, keepdim=True) + ALIKE] = 9.0
    found = CameraPrior(cameras=cameras).best(finalists, views, ANY)
    index = torch.arange(30) * 4 + total.argmin(1)
    assert_close(found.placement.rotation, placement.rotation[index])
    assert_close(found.loss, loss.flatten()[index])
    assert (total.argmin(1) != loss.argmin(1)).sum() > 3
    assert (found.margin < 0).sum() > 0  # where it was overruled, nothing is to be trusted


def test_directions_are_those_of_the_cameras_in_the_template_frame() -> None:
    views, truth = sighted(5, seed=4)
    finalists = Finalists(placement=truth, loss=torch.zeros(5, 1))
    spot = (truth.rotation @ directions(finalists, views).mT)[..., 0]
    away = F.normalize(views.camera - truth.translation, dim=-1)
    assert_close(spot, away, atol=1e-5, rtol=1e-5)


def test_poses_upside_down_are_put_right_by_the_other_views() -> None:
    views, truth = sighted(40, seed=4)  # cameras about one side, above
    flipped = Placement.at(truth.rotation @ OVER, truth.translation, truth.state)
    pairs = torch.arange(80).view(2, 40).T.flatten()
    both = Placement.cat([truth, flipped]).take(pairs)
    loss = torch.full((40, 2), 0.3)
    loss[:, 1] += 0.05 * torch.rand(40, generator=generator(0)) - 0.015  # 30 % look better so
    finalists = Finalists(placement=both, loss=loss)
    wrong = loss.argmin(1) == 1
    assert 8 < wrong.sum() < 20
    rotation = agreed(finalists, views, ANY).placement.rotation
    assert ((rotation - truth.rotation).abs().amax((1, 2)) > 0.01).sum() < 4


def test_what_a_view_tells_clearly_is_not_overruled() -> None:
    views, truth = sighted(40, seed=4)
    rotation = truth.rotation.clone()
    rotation[0] = random_rotations(1, generator(3))[0]
    both = Placement.cat([truth, Placement.at(rotation, truth.translation, truth.state)])
    both = both.take(torch.arange(80).view(2, 40).T.flatten())
    loss = torch.tensor([[0.2, 0.9]]).repeat(40, 1)
    loss[0] = torch.tensor([0.9, 0.2])
    found = agreed(Finalists(placement=both, loss=loss), views, ANY)
    assert_close(found.placement.rotation[0], rotation[0])
    assert_close(found.placement.rotation[1:], truth.rotation[1:])
