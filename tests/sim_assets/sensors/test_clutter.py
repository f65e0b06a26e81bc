# SPDX-License-Identifier: MIT
"""What stands behind and beside the object never hides it."""

from __future__ import annotations

import numpy as np

from sim_assets.sensors.clutter import FARTHEST, Clutter, put_behind, put_beside
from sim_assets.sensors.surface import rays
from tests.helpers.depth_plates import camera, disc, plate

CAMERA = camera(120, 400)


def test_a_plane_stands_behind_everything():
    seen = disc(CAMERA)
    depth = plate(CAMERA, 0.8, 35) * seen
    touching = []
    for seed in range(40):
        scene = put_behind(depth, CAMERA, np.random.default_rng(seed))
        assert np.array_equal(scene[seen], depth[seen])
        behind = ~seen & (scene > 0)
        assert behind.mean() > 0.3
        assert scene.max() <= FARTHEST
        x, y = rays(depth.shape, CAMERA)
        points = np.stack([x * scene, y * scene, scene], -1).astype(np.float64)
        normal, *_ = np.linalg.lstsq(points[behind], np.ones(behind.sum()), rcond=None)
        assert np.abs(points[behind] @ normal - 1).max() < 1e-4  # a plane
        assert (points[seen] @ normal).max() <= 1 + 1e-4  # all in front of it
        touching.append((points[seen] @ normal).max() > 0.9999)
    assert 0.25 < np.mean(touching) < 0.75


def test_a_thing_beside_the_object_leaves_its_pixels_alone():
    seen = disc(CAMERA)
    depth = plate(CAMERA, 0.8, 35) * seen
    shares = []
    for seed in range(60):
        scene, there = put_beside(depth, seen, np.random.default_rng(seed))
        assert np.array_equal(scene[~there], depth[~there])
        assert not (there & seen).any()
        assert (scene[there] > 0).all()
        if there.any():
            assert np.abs(scene[there] - 0.8).max() < 0.6
        shares.append(there.sum() / seen.sum())
    assert 0.3 < np.mean(np.array(shares) > 0) < 0.7
    assert max(shares) < 0.2


def test_a_thing_behind_another_surface_is_hidden_by_it():
    seen = disc(CAMERA, 0.2)
    depth = np.where(seen, 0.8, 0.3).astype(np.float32)
    for seed in range(20):
        scene, there = put_beside(depth, seen, np.random.default_rng(seed), Clutter(chance=1.0))
        assert (scene <= depth).all()
        assert (scene[there] < 0.3).all()
