# SPDX-License-Identifier: MIT
"""Errors of some samples against numbers worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.requests import Settings
from bench.scoring.scores import Frames, reconstruction, score
from bench.scoring.truth import Truth, blocks
from tests.helpers import made

FRAMES = Frames(symmetry=None, revolute=np.array([True]))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    folder: Path = tmp_path_factory.mktemp("data")
    return next(iter(blocks(made.make_data(folder, "oven", count=6, train=6, points=32))))


def told(truth: Truth) -> dict[str, np.ndarray]:
    """The truth as an answer."""
    return {
        "part": truth.part.astype(np.uint8),
        "camera_T_part": truth.camera_T_part.copy(),
        "joint_pivot": truth.joint_pivot.copy(),
        "joint_axis": truth.joint_axis.copy(),
        "joint_state": truth.joint_state.copy(),
    }


def test_lengths_are_in_metres_and_in_units_of_the_cloud(truth: Truth):
    rows = told(truth)
    rows["camera_T_part"][:, 1, 0, 3] += 0.02
    errors = score(truth, rows, settings=Settings(), frames=FRAMES)
    metres = np.tile([0.0, 0.02], (len(truth), 1))
    np.testing.assert_allclose(errors["part_translation", "m"], metres, atol=1e-7)
    np.testing.assert_allclose(errors["part_translation", "r4"], metres / truth.scale[:, None],
                               atol=1e-6)  # fmt: skip
    np.testing.assert_allclose(errors["part_rotation", "deg"], 0, atol=1e-4)


def test_an_offset_of_the_state_is_taken_off(truth: Truth):
    rows = told(truth)
    rows["joint_state"] -= np.float32(0.25)
    for offset, degrees in ((None, np.degrees(0.25)), (np.array([0.25]), 0.0)):
        frames = replace(FRAMES, state_offset=offset)
        errors = score(truth, rows, settings=Settings(), frames=frames)
        np.testing.assert_allclose(errors["joint_state", "deg"], degrees, atol=1e-3)


def test_an_axis_that_points_the_other_way_turns_the_state(truth: Truth):
    rows = told(truth)
    rows["joint_axis"] *= -1
    rows["joint_state"] *= -1
    errors = score(truth, rows, settings=Settings(), frames=FRAMES)
    np.testing.assert_allclose(errors["joint_state", "deg"], 0, atol=1e-3)
    np.testing.assert_allclose(errors["joint_direction", "deg"], 0, atol=1e-3)


def test_reconstruction_needs_poses(truth: Truth):
    shape = np.zeros((len(truth), 4, 3), np.float32)
    rows = {"part": told(truth)["part"], "canonical_points": shape}
    assert np.isnan(reconstruction(truth, rows)).all()
