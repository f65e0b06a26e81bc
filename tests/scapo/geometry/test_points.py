# SPDX-License-Identifier: MIT
"""Clouds: neighbours against scipy's k-d tree, gradients and memory against the full matrix."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from scipy.cluster.vq import kmeans2
from scipy.spatial import KDTree
from torch import Tensor
from torch.testing import assert_close

from scapo.geometry import points as cloud
from tests.helpers.strategies import batch_shapes, normal, rigid_motions, seeds

quick = settings(max_examples=15, deadline=None)
DTYPES = [torch.float32, torch.float64]
CENTRES = [(0.0, 0.0, 0.0), (0.3, -0.4, 1.2), (20.0, 30.0, -50.0)]


def pair(
    seed: int,
    *shape: int,
    dtype: torch.dtype = torch.float64,
    centre: tuple[float, float, float] = CENTRES[0],
) -> tuple[Tensor, Tensor]:
    """Two clouds of 60 and 50 points, about 0.2 m across, near `centre`."""
    offset = torch.tensor(centre, dtype=torch.float64)
    a, b = normal(seed, *shape, 60, 3), normal(seed + 1, *shape, 50, 3)
    return (0.1 * a + offset).to(dtype), (0.1 * b + offset).to(dtype)


def tree_distances(source: Tensor, target: Tensor, k: int = 1) -> np.ndarray:
    """Distances to the k nearest neighbours of one cloud by scipy in double precision."""
    tree = KDTree(target.double().numpy())
    return np.asarray(tree.query(source.double().numpy(), k=k)[0]).reshape(-1, k)


def full_chamfer(a: Tensor, b: Tensor) -> Tensor:
    """The textbook form: every distance of the (N, M) matrix under autograd."""
    squared = (a[..., :, None, :] - b[..., None, :, :]).square().sum(-1)
    return squared.amin(-1).mean(-1) + squared.amin(-2).mean(-1)


def full_robust(a: Tensor, b: Tensor, forward: float, backward: float) -> Tensor:
    squared = (a[..., :, None, :] - b[..., None, :, :]).square().sum(-1)
    there = (1 - torch.exp(-forward * squared.amin(-1))).mean(-1)
    return there + forward / backward * (1 - torch.exp(-backward * squared.amin(-2))).mean(-1)


@pytest.mark.parametrize("centre", CENTRES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_nearest_finds_the_distances_of_the_tree(
    dtype: torch.dtype, centre: tuple[float, float, float]
) -> None:
    source, target = pair(0, 3, 1, 2, dtype=dtype, centre=centre)
    index = cloud.nearest(source, target)
    found = (source - cloud.gather(target, index)).double().norm(dim=-1)
    for i, j in ((0, 0), (2, 1)):
        expected = tree_distances(source[i, 0, j], target[i, 0, j])[:, 0]
        np.testing.assert_allclose(found[i, 0, j].numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("centre", CENTRES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_k_nearest_finds_the_distances_of_the_tree_in_order(
    dtype: torch.dtype, centre: tuple[float, float, float]
) -> None:
    source, target = pair(1, dtype=dtype, centre=centre)
    index = cloud.k_nearest(source, target, 7)
    assert index.shape == (60, 7)
    found = (source[:, None] - target[index]).double().norm(dim=-1)
    np.testing.assert_allclose(found.numpy(), tree_distances(source, target, 7), atol=1e-6)
    assert torch.equal(index.sort(-1).values.diff(dim=-1) > 0, torch.ones(60, 6, dtype=torch.bool))


def test_all_neighbours_are_found_once_each() -> None:
    source, target = pair(2)
    index = cloud.k_nearest(source, target, 50)
    assert torch.equal(index.sort(-1).values, torch.arange(50).expand(60, 50))


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2), (0,), (2, 0)])
def test_neighbours_in_every_batch_shape(shape: tuple[int, ...]) -> None:
    source, target = pair(3, *shape)
    assert cloud.nearest(source, target).shape == (*shape, 60)
    assert cloud.k_nearest(source, target, 4).shape == (*shape, 60, 4)
    assert cloud.nearest(source[..., :0, :], target).shape == (*shape, 0)
    assert cloud.chamfer(source, target).shape == shape


@pytest.mark.parametrize("block", [1, 49, 50, 51, 3000, 3001, 7500, 1 << 30])
def test_the_block_size_changes_nothing(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = pair(4, 5)
    expected, several = cloud.nearest(source, target), cloud.k_nearest(source, target, 3)
    monkeypatch.setattr(cloud, "BLOCK", block)
    assert torch.equal(cloud.nearest(source, target), expected)
    assert torch.equal(cloud.k_nearest(source, target, 3), several)


def test_neighbours_in_half_precision_are_those_of_single() -> None:
    source, target = (x.half() for x in pair(5, centre=CENTRES[1]))
    expected = cloud.nearest(source.float(), target.float())
    assert torch.equal(cloud.nearest(source, target), expected)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(cloud.nearest(source.float(), target.float()), expected)


def test_non_contiguous_clouds() -> None:
    source, target = pair(6, 2)
    flipped = [x.mT.contiguous().mT for x in (source, target)]
    assert not flipped[0].is_contiguous()
    assert torch.equal(cloud.nearest(*flipped), cloud.nearest(source, target))
    assert_close(cloud.chamfer(*flipped), cloud.chamfer(source, target))


@pytest.mark.parametrize("k", [0, 51])
def test_more_neighbours_than_points_are_refused(k: int) -> None:
    source, target = pair(7)
    with pytest.raises(ValueError, match=f"expected 1 to 50, .* found {k}"):
        cloud.k_nearest(source, target, k)


def test_an_empty_target_is_refused() -> None:
    source, target = pair(7)
    with pytest.raises(ValueError, match="expected 1 to 0"):
        cloud.chamfer(source, target[:0])


def test_gather_picks_rows() -> None:
    points, index = normal(0, 2, 5, 4), torch.tensor([[4, 0, 4], [1, 2, 3]])
    found = cloud.gather(points, index)
    for i in range(2):
        assert torch.equal(found[i], points[i][index[i]])


@pytest.mark.parametrize("centre", CENTRES[:2])
@pytest.mark.parametrize("dtype", DTYPES)
def test_chamfer_matches_the_tree(dtype: torch.dtype, centre: tuple[float, float, float]) -> None:
    a, b = pair(8, dtype=dtype, centre=centre)
    expected = (tree_distances(a, b) ** 2).mean() + (tree_distances(b, a) ** 2).mean()
    assert cloud.chamfer(a, b).item() == pytest.approx(expected, rel=1e-5)
    assert_close(cloud.chamfer(b, a), cloud.chamfer(a, b))
    assert cloud.chamfer(a, a.flip(-2)).item() == 0


def test_robust_chamfer_matches_the_tree() -> None:
    a, b = pair(9, dtype=torch.float32, centre=CENTRES[1])
    there, back = tree_distances(a, b) ** 2, tree_distances(b, a) ** 2
    expected = (1 - np.exp(-30 * there)).mean() + 30 / 120 * (1 - np.exp(-120 * back)).mean()
    found = cloud.robust_chamfer(a, b, forward=30, backward=120)
    assert found.item() == pytest.approx(expected, rel=1e-5)


def test_robust_chamfer_by_hand_and_its_bound() -> None:
    a, b = torch.zeros(1, 3), torch.tensor([[0.3, 0.0, 0.4]])  # 0.5 apart
    expected = (1 - np.exp(-2 * 0.25)) + 2 / 5 * (1 - np.exp(-5 * 0.25))
    assert cloud.robust_chamfer(a, b, forward=2, backward=5).item() == pytest.approx(expected)
    far = cloud.robust_chamfer(a, b + 1e3, forward=2, backward=5)
    assert far.item() == pytest.approx(1 + 2 / 5)


@quick
@given(seed=seeds, shape=batch_shapes)
def test_chamfer_ignores_rigid_motion_and_order(seed: int, shape: tuple[int, ...]) -> None:
    a, b = pair(seed, *shape)
    pose = rigid_motions(seed, *shape)
    moved = [x @ pose[..., :3, :3].mT + pose[..., None, :3, 3] for x in (a, b)]
    assert_close(cloud.chamfer(*moved), cloud.chamfer(a, b))
    assert_close(cloud.chamfer(a.flip(-2), b.roll(3, -2)), cloud.chamfer(a, b))


def _robust(a: Tensor, b: Tensor) -> Tensor:
    return cloud.robust_chamfer(a, b, forward=30.0, backward=120.0)


Distance = Callable[[Tensor, Tensor], Tensor]


@pytest.mark.parametrize(
    ("ours", "full"),
    [(cloud.chamfer, full_chamfer), (_robust, lambda a, b: full_robust(a, b, 30.0, 120.0))],
)
@quick
@given(seed=seeds, shape=batch_shapes)
def test_values_and_gradients_equal_the_full_matrix(
    ours: Distance, full: Distance, seed: int, shape: tuple[int, ...]
) -> None:
    grads = []
    for function in (ours, full):
        a, b = (x.requires_grad_() for x in pair(seed, *shape))
        value = function(a, b)
        grads.append((value, *torch.autograd.grad(value.sum(), (a, b))))
    for found, expected in zip(*grads, strict=True):
        assert_close(found, expected)


@pytest.mark.parametrize("function", [cloud.chamfer, _robust])
def test_gradcheck(function: Distance) -> None:
    a, b = (x[:6].requires_grad_() for x in pair(10))
    assert torch.autograd.gradcheck(function, (a.detach().requires_grad_(), b))


@pytest.mark.parametrize("function", [cloud.chamfer, _robust])
def test_no_matrix_is_kept_for_the_backward_pass(function: Distance) -> None:
    a, b = normal(0, 300, 3).requires_grad_(), normal(1, 200, 3).requires_grad_()
    sizes: list[int] = []

    def note(tensor: Tensor) -> Tensor:
        sizes.append(tensor.untyped_storage().nbytes() // tensor.element_size())
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        function(a, b)
        assert 0 < max(sizes) <= 300 * 3
        sizes.clear()
        full_chamfer(a, b)
        assert max(sizes) >= 300 * 200  # the count above would notice one


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_neighbours_and_distances_on_a_gpu_are_those_of_the_cpu() -> None:
    a, b = pair(11, 3, dtype=torch.float32, centre=CENTRES[1])
    on_gpu = (a.cuda(), b.cuda())
    assert torch.equal(cloud.nearest(*on_gpu).cpu(), cloud.nearest(a, b))
    with torch.autocast("cuda", dtype=torch.bfloat16):
        assert torch.equal(cloud.k_nearest(*on_gpu, 5).cpu(), cloud.k_nearest(a, b, 5))
    assert_close(cloud.chamfer(*on_gpu).cpu(), cloud.chamfer(a, b))
    assert torch.equal(cloud.farthest_points(on_gpu[0], 9).cpu(), cloud.farthest_points(a, 9))


def test_k_nearest_of_features():
    source, target = torch.randn(2, 70, 6, generator=torch.Generator().manual_seed(4)).split(
        (30, 40), 1
    )
    index = cloud.k_nearest(source, target, 3)
    assert torch.equal(index, torch.cdist(source, target).topk(3, largest=False).indices)


def test_k_means_are_scipys_and_a_centre_without_points_stays():
    points = normal(3, 60, 3)
    found = cloud.k_means(points, points[:4], 6)
    expected = kmeans2(points.numpy(), points[:4].numpy(), iter=6, minit="matrix")[0]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)
    far = torch.full((1, 3), 100.0, dtype=points.dtype)
    assert torch.equal(cloud.k_means(points, torch.cat([points[:4], far]), 6)[4:], far)


def test_single_wrong_labels_are_outvoted() -> None:
    g = torch.Generator().manual_seed(3)
    target, source = torch.rand(1600, 2, generator=g), torch.rand(2000, 2, generator=g)
    wrong = torch.rand(1600, generator=g) < 0.1
    label = ((target[:, 0] >= 0.5) ^ wrong).long()
    found = cloud.smoothed(source, target, torch.nn.functional.one_hot(label, 2).float())
    assert_close(found.sum(-1), torch.ones(2000), atol=1e-5, rtol=0)
    truth = (source[:, 0] >= 0.5).long()
    single = label[torch.cdist(source, target).argmin(1)]
    assert (single != truth).float().mean() > 0.08
    assert (found.argmax(-1) != truth).float().mean() < 0.03


def test_what_lies_on_a_target_far_from_others_is_its_own() -> None:
    target = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0]])
    assert_close(cloud.smoothed(target, target, torch.eye(3)), torch.eye(3), atol=1e-6, rtol=0)
