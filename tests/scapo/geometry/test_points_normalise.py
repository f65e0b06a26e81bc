# SPDX-License-Identifier: MIT
"""Clouds centred and scaled, and sampled by farthest points."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from scapo.geometry import points as cloud
from tests.helpers.strategies import batch_shapes, normal, rigid_motions, rotations, seeds

quick = settings(max_examples=15, deadline=None)
DTYPES = [torch.float32, torch.float64]


def naive_farthest(points: np.ndarray, count: int, start: int) -> list[int]:
    """The definition: always the point whose nearest chosen point is farthest."""
    chosen = [start]
    while len(chosen) < count:
        gaps = [min(float(((p - points[c]) ** 2).sum()) for c in chosen) for p in points]
        chosen.append(int(np.argmax(gaps)))
    return chosen


@quick
@given(seed=seeds, shape=batch_shapes, start=st.integers(0, 19))
def test_farthest_points_match_the_definition(
    seed: int, shape: tuple[int, ...], start: int
) -> None:
    points = normal(seed, *shape, 20, 3)
    found = cloud.farthest_points(points, 8, start=start)
    assert found.shape == (*shape, 8)
    flat = zip(points.reshape(-1, 20, 3).numpy(), found.reshape(-1, 8).tolist(), strict=True)
    for one, indices in flat:
        assert indices == naive_farthest(one, 8, start)


def test_farthest_points_of_all_is_a_permutation() -> None:
    points = normal(0, 3, 20, 3)
    found = cloud.farthest_points(points, 20)
    assert torch.equal(found.sort(-1).values, torch.arange(20).expand(3, 20))
    assert cloud.farthest_points(points[:0], 4).shape == (0, 4)


@pytest.mark.parametrize(("count", "start"), [(0, 0), (21, 0), (5, 20), (5, -1)])
def test_farthest_points_refuse_what_is_not_there(count: int, start: int) -> None:
    with pytest.raises(ValueError, match=r"sampling: expected .*20.*, found"):
        cloud.farthest_points(normal(0, 20, 3), count, start=start)


@quick
@given(seed=seeds, shape=batch_shapes, scale=st.floats(1e-2, 1e2))
def test_normalise_has_centroid_zero_and_mean_radius_a_quarter(
    seed: int, shape: tuple[int, ...], scale: float
) -> None:
    points = scale * (normal(seed, *shape, 40, 3) + normal(seed + 1, *shape, 1, 3))
    small, similarity = cloud.normalise(points)
    radius = np.linalg.norm(small.numpy(), axis=-1).mean(-1)
    np.testing.assert_allclose(radius, np.full(shape, 0.25))
    assert_close(small.mean(-2), torch.zeros(*shape, 3, dtype=torch.float64), atol=1e-12, rtol=0)
    assert_close(similarity.inverse(small), points)
    assert_close(similarity.forward(points), small)


@quick
@given(seed=seeds, shape=batch_shapes)
def test_normalise_commutes_with_similarities(seed: int, shape: tuple[int, ...]) -> None:
    points, turn = normal(seed, *shape, 40, 3), rotations(seed, *shape)
    small, _ = cloud.normalise(points)
    turned, _ = cloud.normalise(3 * points @ turn.mT + 5)
    assert_close(turned, small @ turn.mT)


def test_inverse_pose_places_the_part_in_metres() -> None:
    points = normal(0, 2, 40, 3) * 0.1 + 1
    _, similarity = cloud.normalise(points)
    pose = rigid_motions(1, 2, 3)
    metric = similarity.inverse_pose(pose)
    assert_close(metric[..., :3, :3], pose[..., :3, :3])
    assert_close(similarity.forward(metric[..., :3, 3]), pose[..., :3, 3])
    # A point p of the part in normalised units is p / scale in metres.
    p = normal(2, 2, 1, 3)
    normalised = p @ pose[:, 0, :3, :3].mT + pose[:, None, 0, :3, 3]
    metres = p / similarity.scale[:, None, None]
    moved = metres @ metric[:, 0, :3, :3].mT + metric[:, None, 0, :3, 3]
    assert_close(moved, similarity.inverse(normalised))
    assert not torch.equal(metric, pose)  # and the argument is left as it was


def test_normalise_passes_gradients() -> None:
    points = normal(0, 5, 3).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: cloud.normalise(x)[0], (points,))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (0.3, 0.1, 0.7)])
def test_normalise_refuses_a_cloud_of_one_place(
    dtype: torch.dtype, at: tuple[float, float, float]
) -> None:
    points = torch.tensor(at, dtype=dtype).expand(1023, 3)
    with pytest.raises(ValueError, match="expected finite points that differ"):
        cloud.normalise(points)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_normalise_refuses_one_bad_coordinate_in_a_batch(bad: float) -> None:
    points = normal(0, 3, 10, 3)
    points[1, 4, 2] = bad
    with pytest.raises(ValueError, match="expected finite points"):
        cloud.normalise(points)


def test_normalise_of_no_clouds_and_of_no_points() -> None:
    small, similarity = cloud.normalise(torch.zeros(0, 5, 3))
    assert small.shape == (0, 5, 3)
    assert similarity.scale.shape == (0,)
    with pytest.raises(ValueError, match="expected finite points"):
        cloud.normalise(torch.zeros(0, 3))


def test_a_similarity_is_frozen() -> None:
    _, similarity = cloud.normalise(normal(0, 5, 3))
    with pytest.raises(FrozenInstanceError):
        similarity.scale = torch.ones(())  # pyright: ignore[reportAttributeAccessIssue]
