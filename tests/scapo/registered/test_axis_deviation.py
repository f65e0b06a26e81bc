# SPDX-License-Identifier: MIT
"""Tilts of a flap are measured, and a template of flaps that lean is found; straight ones stay."""

from __future__ import annotations

from dataclasses import replace

import pytest
import roma
import torch
from torch.testing import assert_close

from scapo.registered.axis_deviation import (
    REACHES,
    leaning_templates,
    measure,
    seat_pivots,
    settle_leans,
    spread_across,
    tilted,
)
from scapo.registered.bundle_adjustment import FitOptions
from scapo.registered.discovery import with_leans
from scapo.registered.initialisation import DiscoveryConfig, Trusted
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator

LEAN = 0.15


def test_the_tilt_of_a_leaning_flap_is_measured() -> None:
    views, truth = sighted(16, seed=5, lean=LEAN)
    made = template()
    straight = replace(truth, lean=torch.zeros_like(truth.lean))
    tilts = measure(made, views, straight, REACHES)
    base = truth.rotation.mT
    leaning, upright = (base @ made.part_poses(at).rotation[:, 1] for at in (truth, straight))
    turn = roma.rotmat_to_rotvec(upright.mT @ leaning)
    got = spread_across(tilts.turn, made)[:, 0]
    off = (got - turn)[tilts.seen[:, 0], 0]  # out of the flap's plane, which its points tell
    assert tilts.seen.float().mean() > 0.8
    assert off.abs().max() < 0.012
    assert turn[:, 0].abs().max() > 0.05


def test_parts_are_posed_as_tilted_about_their_pivot() -> None:
    views, truth = sighted(6, seed=5)
    made = template()
    tilts = measure(made, views, truth, REACHES)
    tilts.turn[:, 0] = torch.tensor(
        [[0.1, 0.0], [-0.1, 0.0], [0.0, 0.2], [0, -0.2], [2, 0], [-2, 0]]
    )
    tilts.seen[:4] = True
    tilts.seen[4:] = False
    poses, straight = tilted(made, truth, tilts), made.part_poses(truth)
    turn = roma.rotmat_to_rotvec(straight.rotation[:, 1].mT @ poses.rotation[:, 1])
    assert_close(turn.norm(dim=-1), torch.tensor([0.1, 0.1, 0.2, 0.2, 0, 0]), atol=1e-4, rtol=1e-3)
    for one in (poses, straight):
        spot = one.rotation[:, 1] @ made.pivot[0].detach() + one.translation[:, 1]
        assert_close(spot, made.joints_in_view(truth)[0][:, 0].detach(), atol=1e-5, rtol=1e-5)
    assert_close(poses.rotation[:, 0], straight.rotation[:, 0])


def test_pivots_slide_to_their_part() -> None:
    made = template()
    with torch.no_grad():
        made.pivot[0, 1] += 0.7
    seat_pivots(made)
    assert made.pivot[0, 1].abs() < 0.1
    assert_close(made.pivot[0, [0, 2]].detach(), torch.tensor([-0.2, -0.15]))


@pytest.mark.slow
def test_flaps_that_lean_are_found_and_told() -> None:
    views, truth = sighted(48, seed=8, lean=LEAN)
    straight = replace(truth, lean=torch.zeros_like(truth.lean))
    index = torch.arange(48)
    held, rest = index[::3], index[index % 3 > 0]
    config = DiscoveryConfig(rotations=300)
    trusted = Trusted(views=views.take(rest), placement=straight.take(rest))
    found, _ = with_leans((template(), trusted), views.take(held), config, generator(0))
    assert found.leans()
    placed, loss = settle_leans(found, views.take(held), straight.take(held))
    got, true = (at.rotation @ found.leaning(at).mT for at in (placed, truth.take(held)))
    angle = torch.rad2deg((got * true).sum(1).clamp(max=1).arccos())
    assert angle.mean() < 4.0 < torch.rad2deg(torch.tensor(LEAN))
    _, before = settle_leans(template(), views.take(held), straight.take(held))
    assert loss.mean() < before.mean()


@pytest.mark.slow
def test_straight_flaps_make_no_leaning_template() -> None:
    views, truth = sighted(24, seed=9)
    options = FitOptions(steps=5)
    assert not leaning_templates(template(), views, truth, options, generator(0))
