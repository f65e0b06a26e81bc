# SPDX-License-Identifier: MIT
"""The published windows number for number (docs/protocol.md), and the benchmark's cameras."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from sim_assets.options import PresetName
from sim_assets.sampling import presets
from sim_assets.sampling.presets import EAP, OP_ALIGN, PRESETS, AngleGrid, AngleSequence

# Degrees at k = 0, 1, 99, worked out from the table of docs/protocol.md.
FULL = {
    "laptop": (-45.0, -44.1, 44.1),  # HOI4D
    "safe": (-45.0, -44.1, 44.1),
    "oven": (45.0, 45.8, 124.2),
    "washer": (45.0, 45.9, 134.1),
}
PARTIAL = {
    "laptop": (-45.0, -44.25, 29.25),
    "safe": (-45.0, -44.25, 29.25),
    "oven": (45.0, 45.7, 114.3),
    "washer": (60.0, 60.6, 119.4),
}


def ends(thetas: AngleSequence | AngleGrid) -> list[float]:
    assert isinstance(thetas, AngleSequence)
    degrees = thetas.degrees()
    assert len(degrees) == 100
    return [degrees[0], degrees[1], degrees[99]]


@pytest.mark.parametrize("name", FULL)
def test_articulation_windows(name):
    assert ends(OP_ALIGN.full[name]) == pytest.approx(FULL[name])
    assert ends(OP_ALIGN.partial[name]) == pytest.approx(PARTIAL[name])
    if name != "laptop":
        assert EAP.full[name] == OP_ALIGN.full[name]
        assert EAP.partial[name] == OP_ALIGN.partial[name]


def test_eap_has_the_laptops_of_shape2motion_and_eyeglasses_a_grid():
    for windows in (EAP.full, EAP.partial):
        assert ends(windows["laptop"]) == pytest.approx((9, 8.1, -80.1))
    for published in (OP_ALIGN, EAP):
        for windows in (published.full, published.partial):
            grid = windows["eyeglasses"]
            assert isinstance(grid, AngleGrid)
            assert (grid.train, grid.test) == pytest.approx((18 * 0.45, 18 * 0.35))
            assert 9 * grid.train == pytest.approx(72.9)


def test_view_grids():
    _, wide = presets.windows("op-align", "oven", "isolated")
    _, narrow = presets.windows("op-align", "safe", "isolated")
    _, full = presets.windows("op-align", "oven", "full")
    assert wide is not None
    assert narrow is not None
    assert full is not None
    assert (wide.order, narrow.order, full.order) == ("yxz", "zyx", "zyx")
    for grid, first, step, last in (
        (wide, -90, 1.8, 88.2),
        (narrow, -22.5, 0.45, 22.05),
        (full, -90, 1.8, 88.2),
    ):
        degrees = grid.degrees()
        assert degrees[[0, -1]] == pytest.approx([first, last])
        assert np.diff(degrees) == pytest.approx(step)
    assert presets.windows("eap", "oven", "full")[1] is None  # uniform over rotations
    assert presets.windows("op-align", "drawer", "isolated") == (None, wide)
    with pytest.raises(ValueError, match="expected a published one"):
        presets.windows("sim-art", "oven", "joint")


def test_cameras():
    assert set(PRESETS) == set(get_args(PresetName))
    clean, sensor = presets.camera("sim-art", None), presets.camera("sim-art-sensor", None)
    assert (clean.width, clean.height) == (256, 256)
    assert np.degrees(2 * np.arctan(128 / clean.fy)) == pytest.approx(60)
    assert sensor.row() == (600, 600, 320, 240, 640, 480)
    for name in ("op-align", "eap"):
        camera = presets.camera(name, None)
        assert (camera.width, camera.height) == (640, 480)
        assert np.degrees(2 * np.arctan(240 / camera.fy)) == pytest.approx(60)
        assert camera.fx == camera.fy
        assert PRESETS[name].protocol == "isolated"
        assert PRESETS[name].sampling == "fps"
    small = presets.camera("sim-art-sensor", 96)
    assert (small.width, small.height) == (96, 96)
    assert small.fx == pytest.approx(600 * 96 / 480)
    with pytest.raises(ValueError, match=r"preset: expected one of sim-art, .*, found 'other'"):
        presets.find_preset("other")


def test_redraw_rule_of_op_align():
    """A sample with 50 points or fewer of label 1, or 150 or fewer of label 0, is drawn again."""
    assert presets.least_points("op-align", "isolated", 2, 1024) == (151, 51)
    assert presets.least_points("op-align", "isolated", 3, 1024) == (151, 51, 0)
    assert presets.least_points("op-align", "isolated", 2, 512) == (76, 26)
    assert presets.least_points("op-align", "full", 2, 1024) == (0, 0)
    assert presets.least_points("eap", "isolated", 2, 1024) == (0, 0)
    assert presets.least_points("sim-art", "joint", 2, 1024) == (0, 0)
