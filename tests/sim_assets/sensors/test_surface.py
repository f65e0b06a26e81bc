# SPDX-License-Identifier: MIT
"""Slopes, angles and edges against plane geometry; flying pixels and holes where they belong."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from sim_assets.sensors.surface import (
    EdgeEffects,
    edges,
    flying_pixels,
    holes,
    incidence,
    surface,
)
from tests.helpers.depth_plates import angles, camera, plate

CAMERA = camera()
WIDE = camera(200)
NO_EFFECT = EdgeEffects(flying=0, lost=0, grazing=None)


@pytest.mark.parametrize("degrees", [0, 10, 45, 70, 78])
@pytest.mark.parametrize("turn", [0.0, 0.7, 2.5])
def test_incidence_on_a_plane_is_the_angle_to_each_ray(degrees, turn):
    depth = plate(CAMERA, 1.3, degrees, turn)
    found = incidence(surface(depth), CAMERA).reshape(depth.shape)
    difference = found - angles(CAMERA, degrees, turn)
    assert np.degrees(np.abs(difference)).max() < 0.5


ASKED = """
import hashlib, numpy as np
from sim_assets.sensors.surface import Surface, incidence
from tests.helpers.depth_plates import camera
draws = np.random.default_rng(1).random((3, 160 * 160), np.float32)
shown = Surface(at=np.arange(160 * 160), inverse=1 + draws[0], slope_u=draws[1] / 50,
                slope_v=draws[2] / 50, across=np.zeros(160 * 160, np.float32))
print(hashlib.sha256(incidence(shown, camera()).tobytes()).hexdigest())
"""


def test_angles_are_the_same_whatever_the_processor_has():
    """A pixel is lost where its share, which goes by the angle, is above a random number."""
    extra = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    said = [
        subprocess.run([sys.executable, "-W", "ignore", "-c", ASKED], capture_output=True,
                       text=True, check=True, env=os.environ | {"NPY_DISABLE_CPU_FEATURES": less})
        for less in ("", " ".join(extra))
    ]  # fmt: skip
    assert said[0].stdout == said[1].stdout


@pytest.mark.parametrize("degrees", [0, 60, 86])
def test_a_plane_has_no_edges_however_steep(degrees):
    assert not edges(surface(plate(CAMERA, 1.0, degrees))).any()


def test_a_step_is_an_edge_on_both_sides():
    depth = np.full((20, 30), 1.0, np.float32)
    depth[:, 15:] = 1.2
    shown = surface(depth)
    across = shown.across.reshape(depth.shape)
    assert np.flatnonzero(edges(shown).reshape(depth.shape)[4]).tolist() == [14, 15]
    assert across[4, 14] == pytest.approx(1 / 1.2 - 1)
    assert across[4, 15] == pytest.approx(1 - 1 / 1.2)
    assert (shown.slope_u == 0).all()
    turned = surface(depth.T.copy()).across
    assert np.array_equal(turned.reshape(30, 20).T, across)


def test_a_small_step_and_a_crease_are_no_edges():
    depth = np.full((20, 30), 1.0, np.float32)
    depth[:, 15:] = 1.005
    assert not edges(surface(depth)).any()
    u = np.abs(np.arange(60) - 30) / 585
    crease = np.broadcast_to(1 + 2 * u, (20, 60)).astype(np.float32)
    assert not edges(surface(crease)).any()


def test_pixels_without_neighbours_have_no_slope_and_nothing_measured_no_edge():
    depth = np.zeros((9, 9), np.float32)
    depth[4, 4] = 0.7
    shown = surface(depth)
    for name in ("slope_u", "slope_v", "across"):
        assert (getattr(shown, name) == 0).all()
    assert np.isfinite(incidence(shown, camera(9))).all()
    some = np.array([40, 3, 80])
    assert np.array_equal(surface(depth, some).inverse, shown.inverse[some])
    depth[2:7, 2:7] = 0.7
    assert not edges(surface(depth)).any()


def step() -> np.ndarray:
    depth = np.full((200, 200), 1.0, np.float32)
    depth[:, 100:] = 1.5
    return depth


def test_flying_pixels_lie_on_their_own_half_of_the_gap():
    depth = step()
    shown = surface(depth)
    model = EdgeEffects(flying=0.4)
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
    gone = holes(shown, WIDE, np.random.default_rng(0), EdgeEffects(lost=0.25, grazing=None))
    assert not gone[~edges(shown)].any()
    assert gone[edges(shown)].mean() == pytest.approx(0.25, abs=0.06)


@pytest.mark.parametrize(
    ("degrees", "share"), [(0, 0.0), (60, 0.0), (77.5, 0.5), (73.75, 0.15625), (89, 1.0)]
)
def test_holes_at_grazing_angles(degrees, share):
    shown = surface(plate(WIDE, 1.0, degrees, 0.0))
    gone = holes(shown, WIDE, np.random.default_rng(0), EdgeEffects(lost=0)).reshape(200, 200)
    assert gone[:, 97:103].mean() == pytest.approx(share, abs=0.05)


def test_without_shares_nothing_happens():
    shown = surface(step())
    depth = step().ravel()
    assert np.array_equal(flying_pixels(depth, shown, np.random.default_rng(0), NO_EFFECT), depth)
    assert not holes(shown, WIDE, np.random.default_rng(0), NO_EFFECT).any()
