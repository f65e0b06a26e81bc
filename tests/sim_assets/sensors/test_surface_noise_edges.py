# SPDX-License-Identifier: MIT
"""Flying pixels lie between the two surfaces of an edge; holes grow with the incidence angle."""

from __future__ import annotations

import numpy as np
import pytest

from sim_assets.sensors.surface import Edges, edges, flying_pixels, holes, surface
from tests.helpers.depth_plates import camera, plate

CAMERA = camera(200)
QUIET = Edges(flying=0, lost=0, grazing=None)


def step() -> np.ndarray:
    depth = np.full((200, 200), 1.0, np.float32)
    depth[:, 100:] = 1.5
    return depth


def test_flying_pixels_lie_on_their_own_half_of_the_gap():
    depth = step()
    shown = surface(depth)
    model = Edges(flying=0.4)
    found = flying_pixels(depth.ravel(), shown, np.random.default_rng(0), model)
    moved = found != depth.ravel()
    assert not moved[~edges(shown)].any()
    assert moved[edges(shown)].mean() == pytest.approx(0.4, abs=0.08)
    found, moved = found.reshape(depth.shape), moved.reshape(depth.shape)
    middle = 2 / (1 / 1.0 + 1 / 1.5)
    near, far = found[:, 99][moved[:, 99]], found[:, 100][moved[:, 100]]
    assert 1.0 <= near.min() < near.max() <= middle + 1e-6 <= far.min() + 2e-6
    assert far.max() <= 1.5


def test_holes_beside_edges_have_the_given_share():
    shown = surface(step())
    gone = holes(shown, CAMERA, np.random.default_rng(0), Edges(lost=0.25, grazing=None))
    assert not gone[~edges(shown)].any()
    assert gone[edges(shown)].mean() == pytest.approx(0.25, abs=0.06)


@pytest.mark.parametrize(
    ("degrees", "share"), [(0, 0.0), (60, 0.0), (77.5, 0.5), (73.75, 0.15625), (89, 1.0)]
)
def test_holes_at_grazing_angles(degrees, share):
    shown = surface(plate(CAMERA, 1.0, degrees, 0.0))
    gone = holes(shown, CAMERA, np.random.default_rng(0), Edges(lost=0)).reshape(200, 200)
    assert gone[:, 97:103].mean() == pytest.approx(share, abs=0.05)


def test_without_shares_nothing_happens():
    shown = surface(step())
    depth = step().ravel()
    assert np.array_equal(flying_pixels(depth, shown, np.random.default_rng(0), QUIET), depth)
    assert not holes(shown, CAMERA, np.random.default_rng(0), QUIET).any()
