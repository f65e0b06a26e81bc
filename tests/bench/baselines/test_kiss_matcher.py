# SPDX-License-Identifier: MIT
"""Global registration finds what it has seen; without its package it says what to install."""

from __future__ import annotations

import sys
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from bench.baselines.kiss_matcher import KissMatcher, KissMatcherConfig, keypoints, voxels
from bench.baselines.registration import Target
from scapo.categories import CATEGORIES
from scapo.geometry.rigid import rotation_angle
from scapo.records import take
from tests.helpers.objects import objects
from tests.helpers.strategies import generator, rotations

installed = pytest.mark.skipif(
    find_spec("kiss_matcher") is None, reason="the package kiss-matcher is not installed"
)
CONFIG = KissMatcherConfig(templates=1, states=2, part_points=1500)


def test_without_the_package_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "kiss_matcher", None)
    with pytest.raises(RuntimeError, match=r"pip install kiss-matcher\), found none"):
        KissMatcher(CONFIG, CATEGORIES["oven"], generator(0))


def test_keypoints_are_points_with_neighbours_enough() -> None:
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(4), 0.0), -1).reshape(-1, 3) * 0.03
    assert keypoints(grid, 0.03) == 20
    assert keypoints(100 * grid, 0.03) == 0
    assert keypoints(np.concatenate([grid, 100 * grid[-1:]]), 0.03) == 20
    assert keypoints(grid[:2], 0.03) == 0


def test_voxels_hold_their_mean() -> None:
    points = np.array([[0.01, 0.01, 0.01], [0.03, 0.03, 0.03], [0.51, 0.5, 0.5]])
    found = voxels(points, 0.1)
    assert found[found[:, 0].argsort()] == pytest.approx(
        np.array([[0.02, 0.02, 0.02], [0.51, 0.5, 0.5]]), abs=1e-6
    )


def lumps(seed: int) -> np.ndarray:
    """A shape like no turned one: three boxes' surfaces of different sizes, 6,000 points."""
    rng = np.random.default_rng(seed)
    made = []
    for half, middle in (((0.3, 0.2, 0.1), (0, 0, 0)), ((0.08, 0.05, 0.15), (0.2, 0.1, 0.2)),
                         ((0.05, 0.1, 0.06), (-0.2, -0.1, 0.12))):  # fmt: skip
        points = rng.uniform(-1, 1, (2000, 3))
        face = rng.integers(0, 3, 2000)
        points[np.arange(2000), face] = np.sign(points[np.arange(2000), face])
        made.append(points * half + middle)
    return np.concatenate(made)


@installed
def test_first_poses_tell_how_a_shape_is_turned() -> None:
    method = KissMatcher(CONFIG, CATEGORIES["oven"], generator(0))
    target = Target(0, 0, lumps(0))
    right = 0
    for seed in range(5):
        turn = rotations(seed).numpy()
        cloud = lumps(seed + 1) @ turn.T + [0.1, -0.2, 0.3]
        for _, pose in method._first_poses(cloud, [target]):
            apart = rotation_angle(torch.tensor(pose[:3, :3]), torch.tensor(turn.T))
            right += bool(apart.rad2deg() < 15)
    assert right >= 3


@installed
def test_a_cloud_without_features_has_no_first_pose() -> None:
    method = KissMatcher(CONFIG, CATEGORIES["oven"], generator(0))
    target = Target(0, 0, lumps(0))
    assert list(method._first_poses(np.eye(3), [target])) == []
    assert list(method._first_poses(lumps(1), [Target(0, 0, 10 * np.eye(3))])) == []


@installed
def test_training_objects_are_answered_and_sparse_ones_too() -> None:
    seen = objects(1, 6, points=800, seed=5)
    method = KissMatcher(CONFIG, CATEGORIES["oven"], generator(0))
    method.start("", seen.observation, seen.labels.keep(method.supervision), generator(1))
    some, labels = take((seen.observation, seen.labels), torch.tensor([0, 3]))
    for found in (method.predict(some), method.predict_given(some, labels.keep(method.oracle))):
        assert found.camera_T_part is not None
        assert found.joints is not None
        assert bool(torch.isfinite(found.camera_T_part).all())
        assert bool(torch.isfinite(found.joints.state).all())
    sparse = method.predict(type(some)(points=100 * torch.randn(1, 12, 3, generator=generator(2))))
    assert sparse.part_weight.shape == (1, 12, 2)
