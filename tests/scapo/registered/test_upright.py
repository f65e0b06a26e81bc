# SPDX-License-Identifier: MIT
"""Turned upright: up is where it is known to be, by the least turn, about the base's middle."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize
from torch.testing import assert_close

from scapo.categories import CATEGORIES
from scapo.geometry.rigid import axis_angle, random_rotations, rotation_angle
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.registered.config import DiscoveryConfig, RegisteredConfig
from scapo.registered.method import TemplateRegistration
from scapo.registered.pose_search import SearchSpace
from scapo.registered.template import Placement
from scapo.registered.upright import Upright
from scapo.registered.view_bank import ShownPoints, ViewBank
from scapo.registered.view_network import ViewNetwork
from scapo.types import Observation
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator

OWN = torch.tensor([0.0, 0.6, 0.8])


def middle(placement: Placement) -> Tensor:
    """Of the base's box, in the frames of the views."""
    centre = template().part_centres()[0] * placement.log_scale.exp()
    return (placement.rotation @ centre[..., None])[..., 0] + placement.translation


def leaning_placements(count: int, angle: float) -> tuple[Placement, Upright]:
    """Two placements of each cloud that lean by this angle, each its own way."""
    g = generator(3)
    rotation = random_rotations(2 * count, g)
    placement = Placement.at(
        rotation, torch.randn(2 * count, 3, generator=g), torch.zeros(2 * count, 1)
    )
    placement = replace(placement, log_scale=0.2 * torch.randn(2 * count, 3, generator=g))
    seen = rotation[::2] @ OWN
    aside = normalize(torch.linalg.cross(seen, torch.randn(count, 3, generator=g)), dim=-1)
    tilt = rotvec_to_rotmat(angle * aside).repeat_interleave(2, 0)
    yaw = rotvec_to_rotmat(torch.rand(2 * count, 1, generator=g) * seen.repeat_interleave(2, 0))
    turned = tilt @ yaw @ rotation[::2].repeat_interleave(2, 0)
    return replace(placement, rotation=turned), Upright(own=OWN, seen=seen)


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2, 3.0])
def test_raised_by_the_least_turn_about_the_middle(angle: float):
    placement, upright = leaning_placements(5, angle)
    lean = upright.leaning(placement.rotation.unflatten(0, (5, 2)))
    assert_close(lean, torch.full((5, 2), 1 - torch.tensor(angle).cos().item()), atol=1e-5, rtol=0)
    raised = upright.raised(template(), placement)
    up = upright.seen.repeat_interleave(2, 0)
    assert axis_angle(raised.rotation @ OWN, up).max() < 2e-3
    assert_close(
        rotation_angle(raised.rotation, placement.rotation),
        torch.full((10,), angle), atol=2e-3, rtol=0,
    )  # fmt: skip
    assert_close(middle(raised), middle(placement), atol=1e-5, rtol=0)
    assert_close(raised.state, placement.state)


def test_proposals_that_stand_right_come_first():
    """Of many that look alike those that lean least are taken, whatever their loss."""
    views, truth = sighted(4, seed=8)
    own = torch.tensor([0.0, 0.0, 1.0])
    placed = ViewBank.placed(
        template(),
        ShownPoints.of(views),
        truth,
        normalize(views.camera - truth.translation, dim=-1),
    )
    rendered = ViewBank.rendered(template(), truth, None)
    space = SearchSpace(rendered=rendered, placed=placed, states=torch.zeros(1, 1))
    upright = Upright(own=own, seen=truth.rotation @ own)

    def lean(made: SearchSpace) -> Tensor:
        found = made.propose(views, 4).rotation.unflatten(0, (4, 4))
        return upright.leaning(found).mean()

    assert lean(replace(space, upright=upright)) < 0.5 * lean(space)


def untaught() -> tuple[TemplateRegistration, Observation, Placement]:
    """The true template, found in 12 clouds, without a network; 4 others, and their truth."""
    views, truth = sighted(12, seed=60)
    config = RegisteredConfig(points=128, channels=8, discovery=DiscoveryConfig(final_points=400))
    method = TemplateRegistration(config, CATEGORIES["oven"], generator(0))
    method.template.load_state_dict(template().state_dict())
    camera = (truth.rotation.mT @ (views.camera - truth.translation)[..., None])[..., 0]
    method.pseudo.set(views.points[:, 0], truth, camera, torch.ones(12))
    method.pseudo.show(ShownPoints.of(views))
    others, poses = sighted(4, seed=62)
    cloud = others.points - others.camera[:, None]  # the camera at the origin
    return method.eval(), Observation(points=cloud), poses


@pytest.mark.parametrize("mode", ["fast", "quick", "refine"])
def test_answers_stand_upright(mode):
    """Even what a network says that was never taught."""
    method, observation, truth = untaught()
    method.up = (0.0, 1.0, 0.0)
    up = truth.rotation[..., 1]
    assert isinstance(method.network, ViewNetwork)
    method.network.learned.fill_(float(mode == "fast"))
    found = method.predict(replace(observation, up=up), mode)
    assert found.camera_T_part is not None
    assert axis_angle(found.camera_T_part[:, 0, :3, 1], up).max() < 2e-3
    if mode != "fast":
        errors = rotation_angle(found.camera_T_part[:, 0, :3, :3], truth.rotation)
        assert errors.rad2deg().median() < 6


def test_who_does_not_know_its_own_up_says_so():
    method, observation, truth = untaught()
    with pytest.raises(ValueError, match="up: expected a model in the object's frame"):
        method.predict(replace(observation, up=truth.rotation[..., 1]))
