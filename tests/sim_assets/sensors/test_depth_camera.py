# SPDX-License-Identifier: MIT
"""Whole pictures through the sensor: what is kept, what it is labelled, what never changes."""

from __future__ import annotations

import time
from typing import get_args

import numpy as np
import pytest

from scapo.geometry.camera import Intrinsics
from sim_assets.options import Mask, Noise
from sim_assets.rendering.base import Frame
from sim_assets.sensors.clutter import Clutter
from sim_assets.sensors.depth_camera import FOREIGN_COLOR, Sensor, corrupt, measure, measure_some
from sim_assets.sensors.disparity import Disparity
from sim_assets.sensors.kinect import Kinect
from sim_assets.sensors.mask import MaskErrors
from sim_assets.sensors.surface import EdgeEffects
from tests.helpers.depth_plates import disc, plate

CAMERA = Intrinsics(fx=600, fy=600, cx=160, cy=120, width=320, height=240)
EVERY = [(noise, mask) for noise in get_args(Noise) for mask in get_args(Mask)]
QUIET = EdgeEffects(flying=0, lost=0, grazing=None)


@pytest.fixture(scope="module")
def picture() -> tuple[np.ndarray, np.ndarray]:
    """Two plates, one in front of the other, and nothing around them."""
    depth = plate(CAMERA, 0.8, 30) * disc(CAMERA)
    part = np.where(depth > 0, 0, 255).astype(np.uint8)
    near = np.zeros_like(part, bool)
    near[100:150, 120:180] = True
    part[near] = 1
    return np.where(near, plate(CAMERA, 0.7, 10), depth).astype(np.float32), part


@pytest.mark.parametrize(("noise", "mask"), EVERY)
def test_the_result_depends_on_the_generator_alone(picture, noise, mask):
    before = [array.copy() for array in picture]
    sensor = Sensor(noise=noise, mask=mask)
    made = [
        corrupt(picture[0], picture[1], CAMERA, np.random.default_rng(s), sensor) for s in (7, 7, 8)
    ]
    for k in range(2):
        assert np.array_equal(made[0][k], made[1][k])
        assert np.array_equal(picture[k], before[k])  # the input is left alone
        assert made[0][k].dtype == picture[k].dtype
    changed = (noise, mask) != ("none", "exact")
    assert np.array_equal(made[0][0], made[2][0]) is not changed


@pytest.mark.parametrize(("noise", "mask"), EVERY)
def test_points_lie_near_the_surface_of_their_label(picture, noise, mask):
    depth, part = picture
    surfaces = {0: plate(CAMERA, 0.8, 30), 1: plate(CAMERA, 0.7, 10)}
    model = Sensor(noise=noise, mask=mask, edges=QUIET)
    for seed in range(5):
        found, label = corrupt(depth, part, CAMERA, np.random.default_rng(seed), model)
        for number, clean in surfaces.items():
            mine = (label == number) & (found > 0)
            assert mine.sum() > 0.7 * (part == number).sum()
            error = np.abs(found - clean)[mine]
            # Between pixels the disparity model mixes the surfaces of an edge.
            assert np.percentile(error, 95 if noise == "disparity" else 100) < 0.012
        assert (label[found == 0] == 255).all()
        assert (found[label < 2] > 0).all()


@pytest.mark.parametrize("noise", ["kinect", "disparity"])
def test_an_exact_mask_keeps_no_foreign_point_and_adds_none(picture, noise):
    depth, part = picture
    sensor = Sensor(noise=noise, mask="exact")
    for seed in range(5):
        found, label = corrupt(depth, part, CAMERA, np.random.default_rng(seed), sensor)
        assert not (found > 0)[part == 255].any()
        assert not ((found > 0) & (label == 255)).any()
        assert (found > 0).sum() > 0.9 * (depth > 0).sum()


def test_an_imperfect_mask_lets_foreign_points_in_and_loses_others(picture):
    depth, part = picture
    sensor = Sensor(noise="disparity", mask="imperfect")
    foreign, missed = [], []
    for seed in range(40):
        found, label = corrupt(depth, part, CAMERA, np.random.default_rng(seed), sensor)
        foreign.append(((found > 0) & (label == 255)).sum() / (found > 0).sum())
        missed.append(((found == 0) & (part != 255)).sum() / (part != 255).sum())
    assert 0.005 < np.mean(foreign) < 0.1
    assert np.mean(np.array(foreign) > 0) > 0.5
    assert 0.01 < np.mean(missed) < 0.2
    assert max(missed) < 0.5


@pytest.mark.parametrize("noise", ["kinect", "disparity"])
def test_a_sensor_without_errors_returns_the_picture(picture, noise):
    sensor = Sensor(
        noise=noise,
        mask="imperfect",
        kinect=Kinect(axial=0, axial_square=0, axial_angle=0, lateral=0, lateral_angle=0),
        disparity=Disparity(sigma=0, shift=0, rounded=False),
        edges=QUIET,
        clutter=Clutter(chance=0),
        errors=MaskErrors(grow=(0, 0), waves=0, missed=0),
    )
    found, label = corrupt(picture[0], picture[1], CAMERA, np.random.default_rng(0), sensor)
    assert np.array_equal(found, picture[0])
    assert np.array_equal(label, picture[1])


def test_flying_pixels_leave_the_surfaces_and_only_at_edges(picture):
    depth, part = picture
    far = np.zeros(2)
    for k, share in enumerate((0.0, 0.5)):
        model = Sensor(noise="kinect", mask="exact", edges=EdgeEffects(flying=share, lost=0))
        found, label = corrupt(depth, part, CAMERA, np.random.default_rng(0), model)
        clean = np.where(label == 1, plate(CAMERA, 0.7, 10), plate(CAMERA, 0.8, 30))
        off = (found > 0) & (np.abs(found - clean) > 0.012)
        far[k] = off.sum()
        inner = np.zeros_like(off)
        inner[105:145, 125:175] = True
        assert not off[inner].any()
    assert far[0] == 0
    assert far[1] > 50


def test_an_empty_picture_and_one_that_fills_the_image():
    empty = np.zeros((240, 320), np.float32)
    nothing = np.full(empty.shape, 255, np.uint8)
    sensor = Sensor(noise="kinect", mask="imperfect")
    found, label = corrupt(empty, nothing, CAMERA, np.random.default_rng(0), sensor)
    assert not found.any()
    assert (label == 255).all()
    full = plate(CAMERA, 0.8, 20)
    found, _ = corrupt(full, np.zeros_like(nothing), CAMERA, np.random.default_rng(0), sensor)
    assert (found > 0).mean() > 0.8
    one = np.where(np.arange(320) == 5, full, 0)
    one[1:] = 0
    part = np.where(one > 0, 0, 255).astype(np.uint8)
    for seed in range(5):
        corrupt(one, part, CAMERA, np.random.default_rng(seed), sensor)


def test_foreign_points_are_grey(picture):
    color = np.zeros((*picture[0].shape, 3), np.uint8)
    frame = Frame(depth=picture[0], part=picture[1], color=color)
    seen = measure(frame, CAMERA, np.random.default_rng(1), Sensor(noise="none", mask="imperfect"))
    foreign = (seen.part == 255) & (seen.depth > 0)
    assert foreign.any()
    assert seen.color is not None
    assert (seen.color[foreign] == FOREIGN_COLOR).all()
    assert (seen.color[~foreign] == 0).all()


@pytest.mark.parametrize("noise", ["kinect", "disparity"])
def test_some_pixels_are_as_good_as_all(picture, noise):
    depth, part = picture
    sensor = Sensor(noise=noise, mask="imperfect")
    shares = []
    for seed in range(20):
        rngs = [np.random.default_rng(seed) for _ in range(2)]
        whole, labels = corrupt(depth, part, CAMERA, rngs[0], sensor)
        some, few = corrupt(depth, part, CAMERA, rngs[1], sensor, 0.1)
        assert not (some > 0)[whole == 0].all()
        shares.append((some > 0).sum() / (whole > 0).sum())
        for label in (0, 1):  # the proportion of parts stays
            a, b = (
                (labels == label).sum() / (whole > 0).sum(),
                (few == label).sum() / (some > 0).sum(),
            )
            assert a == pytest.approx(b, abs=0.06)
    assert shares == pytest.approx([0.1] * 20, rel=0.05)


def test_parts_rendered_alone_keep_their_proportion():
    frames = []
    for share in (0.4, 0.1):
        depth = plate(CAMERA, 0.8, 30) * disc(CAMERA, share)
        frames.append(Frame(depth=depth, part=np.where(depth > 0, 0, 255).astype(np.uint8)))
    pixels = [int((frame.depth > 0).sum()) for frame in frames]
    for noise, mask in EVERY:
        sensor, rng = Sensor(noise=noise, mask=mask), np.random.default_rng(0)
        seen = measure_some(frames, CAMERA, rng, sensor, 2000)
        found = [int((frame.depth > 0).sum()) for frame in seen]
        if (noise, mask) == ("none", "exact"):
            assert found == pixels
        else:
            assert sum(found) == pytest.approx(2000, rel=0.2)
            assert found[1] / found[0] == pytest.approx(pixels[1] / pixels[0], rel=0.35)


@pytest.mark.parametrize("noise", ["kinect", "disparity"])
def test_a_picture_takes_milliseconds(noise):
    """About 2 ms on a quiet machine for what a cloud needs; the bound allows for a busy one."""
    seen_by = Intrinsics.from_fov(np.radians(60), 256, 256)
    depth = plate(seen_by, 0.8, 30) * disc(seen_by, 0.4)
    part = np.where(depth > 0, 0, 255).astype(np.uint8)
    sensor, rng = Sensor(noise=noise, mask="exact"), np.random.default_rng(0)
    spent = []
    for _ in range(10):
        started = time.process_time()
        corrupt(depth, part, seen_by, rng, sensor, 0.1)
        spent.append(time.process_time() - started)
    assert min(spent) < 0.02
