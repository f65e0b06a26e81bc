# SPDX-License-Identifier: MIT
"""Nearest neighbours, Chamfer distance, farthest-point sampling and normalisation of clouds.

Neighbours are found without autograd and gradients pass through the matched points only: the
gradient is the same and no (N, M) matrix is kept for the backward pass.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from scapo.geometry.numerics import at_least_float32, exact, uncompiled


@torch.no_grad()
def nearest(
    source: Float[Tensor, "*B N D"], target: Float[Tensor, "*B M D"]
) -> Int[Tensor, "*B N"]:
    """Index into `target` of the nearest neighbour of each source point, as `k_nearest` has it.

    Raises:
        ValueError: `target` has no points.
    """
    return _search(source, target, 1)[..., 0]


@torch.no_grad()
def k_nearest(
    source: Float[Tensor, "*B N D"], target: Float[Tensor, "*B M D"], k: int
) -> Int[Tensor, "*B N {k}"]:
    """Indices into `target` of the k nearest neighbours of each source point, nearest first.

    Points of space, or features of any dimension D.

    Raises:
        ValueError: `target` has fewer than k points.
    """
    return _search(source, target, k)


@torch.no_grad()
def k_nearest_by_tree(
    source: Float[Tensor, "N D"], target: Float[Tensor, "M D"], k: int
) -> Int[Tensor, "N {k}"]:
    """The same as `k_nearest` of one cloud, on a CPU by a k-d tree.

    In few dimensions, with a thousand points and a dozen neighbours, several times as fast. Of
    neighbours that are equally far either may come first.

    Raises:
        ValueError: `target` has fewer than k points.
    """
    if source.device.type != "cpu" or not 1 <= k <= len(target):
        return k_nearest(source, target, k)
    _, index = KDTree(target.numpy()).query(source.numpy(), k=k)
    return torch.from_numpy(np.asarray(index, np.int64).reshape(-1, k))


NEIGHBOURS = 12
"""Points of a template that tell the part of an observed one."""
REACH = 0.04
"""Of their weights, normalised length."""


@torch.no_grad()
def smoothed(
    source: Float[Tensor, "N D"], target: Float[Tensor, "M D"], values: Float[Tensor, "M P"]
) -> Float[Tensor, "N P"]:
    """Mean of the values at the nearest targets, a Gaussian of `REACH` beyond the nearest.

    The labels of single template points are noisy where two parts meet, and wrong where a point of
    one part lies a little nearer to a sparse surface of another.

    Args:
        source: Normalised positions, or positions and normals (`oriented`).
        target: The same of the points that have values.
        values: Such as weights of parts.
    """
    index = k_nearest_by_tree(source, target, min(NEIGHBOURS, len(target)))
    off = (source[:, None] - target[index]).square().sum(-1)
    share = torch.exp((off[:, :1] - off) / (2 * REACH**2))
    share = share / share.sum(-1, keepdim=True)
    return (share[..., None] * values[index]).sum(1)


@uncompiled  # blocks, numpy and exact arithmetic are no matter for a compiler
def _search(
    source: Float[Tensor, "*B N D"], target: Float[Tensor, "*B M D"], k: int
) -> Int[Tensor, "*B N {k}"]:
    """The k smallest scores |t|^2 - 2 s.t of each row, a block of the score matrix at a time.

    The clouds are moved to the target's centroid first: without that, coordinates a metre off
    cost float32 three digits. Half precision is searched in float32.
    """
    n, m = source.shape[-2], target.shape[-2]
    if not 1 <= k <= m:
        raise ValueError(f"neighbours: expected 1 to {m}, the points of the target, found {k}")
    shape, wide = source.shape[:-1], source.shape[-1]
    clouds = math.prod(shape[:-1])
    dtype = torch.promote_types(source.dtype, torch.float32)
    source = source.detach().to(dtype).reshape(clouds, n, wide)
    target = target.detach().to(dtype).reshape(clouds, m, wide)
    centre = target.mean(1, keepdim=True)
    source, target = source - centre, target - centre
    left: Any = torch.cat([source, torch.ones_like(source[..., :1])], -1)
    right: Any = torch.cat([-2 * target, target.square().sum(-1, keepdim=True)], -1).mT
    kind, block = source.device.type, 2048 * BLOCK
    found = [torch.zeros(0, k, dtype=torch.long, device=source.device)]
    if kind == "cpu":  # by numpy: thin matrices in a sixth of MKL's time, and argmin in vectors
        left, right, block = left.numpy(), right.numpy(), BLOCK
    with exact(kind):  # fewer digits would find the wrong neighbours
        for cloud, row in _blocks((clouds, n, m), block):
            scores = left[cloud, row] @ right[cloud]
            if k == 1:
                least = scores.argmin(-1)
            else:
                least = torch.as_tensor(scores).topk(k, largest=False).indices
            found.append(torch.as_tensor(least).reshape(-1, k))
    return torch.cat(found).reshape(*shape, k)


BLOCK = 1 << 15
"""Scores held at a time on the CPU: 128 KiB in float32. More leave a core's own cache, which costs
several times as long where others compute beside it; the results do not depend on it."""


def _blocks(shape: tuple[int, int, int], block: int) -> Iterator[tuple[slice, slice]]:
    """Clouds, and rows of one, whose scores fit at a time, in order; shape: of all scores."""
    clouds, rows = max(1, block // max(1, shape[1] * shape[2])), max(1, block // shape[2])
    for k in range(0, shape[0], clouds):
        for j in range(0, shape[1], rows):
            yield slice(k, k + clouds), slice(j, j + rows)


def gather(points: Float[Tensor, "*B M C"], index: Int[Tensor, "*B K"]) -> Float[Tensor, "*B K C"]:
    """points[..., index, :] per batch element."""
    return points.gather(-2, index[..., None].expand(*index.shape, points.shape[-1]))


def squared_distances(
    source: Float[Tensor, "*B N D"], target: Float[Tensor, "*B M D"]
) -> Float[Tensor, "*B N"]:
    """Squared distance of each source point to its nearest target point, with gradients."""
    return (source - gather(target, nearest(source, target))).square().sum(-1)


def chamfer(a: Float[Tensor, "*B N 3"], b: Float[Tensor, "*B M 3"]) -> Float[Tensor, "*B"]:
    """Mean squared nearest-neighbour distance, both ways added."""
    return squared_distances(a, b).mean(-1) + squared_distances(b, a).mean(-1)


def robust_chamfer(
    a: Float[Tensor, "*B N 3"],
    b: Float[Tensor, "*B M 3"],
    *,
    forward: float,
    backward: float,
) -> Float[Tensor, "*B"]:
    """mean(1 - exp(-f D_ab)) + (f / b) mean(1 - exp(-b D_ba)), D squared distances.

    OP-Align's form for partial clouds (L_rigid), f = `forward`, b = `backward`:
    a point of the shape far from every observed point costs a bounded amount.
    """
    there = 1 - torch.exp(-forward * squared_distances(a, b))
    back = 1 - torch.exp(-backward * squared_distances(b, a))
    return there.mean(-1) + forward / backward * back.mean(-1)


@torch.no_grad()
def farthest_points(
    points: Float[Tensor, "*B N D"], count: int, *, start: int = 0
) -> Int[Tensor, "*B {count}"]:
    """Indices of farthest-point sampling, beginning with point `start`.

    Points of space, or features of any dimension D.

    Raises:
        ValueError: The cloud has fewer than `count` points, or no point `start`.
    """
    if not 1 <= count <= points.shape[-2]:
        raise ValueError(f"sampling: expected 1 to {points.shape[-2]} points, found {count}")
    if not 0 <= start < points.shape[-2]:
        raise ValueError(f"sampling: expected a start below {points.shape[-2]}, found {start}")
    if points.device.type == "cpu":
        return _spread_on_host(points, count, start)
    return _spread(points, count, start)


def _spread(points: Float[Tensor, "*B N D"], count: int, start: int) -> Int[Tensor, "*B {count}"]:
    chosen = torch.full(points.shape[:-2], start, device=points.device)
    distance = torch.full(points.shape[:-1], torch.inf, dtype=points.dtype, device=points.device)
    columns = points.movedim(-1, 0).contiguous()  # sums over a short last dimension take longer
    indices = [chosen]
    for _ in range(count - 1):
        latest = gather(points, chosen[..., None]).movedim(-1, 0)
        distance = torch.minimum(distance, (columns - latest).square().sum(0))
        chosen = distance.argmax(-1)
        indices.append(chosen)
    return torch.stack(indices, -1)


@uncompiled  # each of the many small steps would be compiled by itself, for minutes
def _spread_on_host(
    points: Float[Tensor, "*B N D"], count: int, start: int
) -> Int[Tensor, "*B {count}"]:
    """The same by numpy, whose small steps take a quarter of the time of torch's."""
    rows = at_least_float32(points).reshape(-1, *points.shape[-2:])
    columns = rows.movedim(-1, 0).contiguous().numpy()
    clouds = np.arange(columns.shape[1])
    chosen = np.full(len(clouds), start)
    distance = np.full(columns.shape[1:], np.inf, columns.dtype)
    indices = [chosen]
    for _ in range(count - 1):
        off = columns - columns[:, clouds, chosen][..., None]
        off *= off
        np.minimum(distance, off.sum(0), out=distance)
        chosen = distance.argmax(-1)
        indices.append(chosen)
    return torch.from_numpy(np.stack(indices, -1).reshape(*points.shape[:-2], count))


@torch.no_grad()
def k_means(
    points: Float[Tensor, "N D"], centres: Float[Tensor, "K D"], rounds: int
) -> Float[Tensor, "K D"]:
    """Centres after rounds of Lloyd's algorithm; one that loses all its points stays."""
    for _ in range(rounds):
        label = torch.cdist(points, centres).argmin(-1)
        means = torch.stack([points[label == k].mean(0) for k in range(len(centres))])
        centres = torch.where(means.isnan(), centres, means)
    return centres


SPAN = (0.02, 0.98)
"""Quantiles of coordinates that count as the ends of a shape."""
MEAN_RADIUS = 0.25
"""Mean distance of the points from their centroid after `normalise`: a length of 1 is
4 times the mean radius of that cloud."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Similarity:
    """normalised = (metric - centre) * scale."""

    scale: Float[Tensor, "*B"]
    centre: Float[Tensor, "*B 3"]

    def forward(self, points: Float[Tensor, "*B K 3"]) -> Float[Tensor, "*B K 3"]:
        """Metres to normalised units."""
        return (points - self.centre[..., None, :]) * self.scale[..., None, None]

    def inverse(self, points: Float[Tensor, "*B K 3"]) -> Float[Tensor, "*B K 3"]:
        """Normalised units to metres."""
        return points / self.scale[..., None, None] + self.centre[..., None, :]

    def inverse_pose(self, pose: Float[Tensor, "*B P 4 4"]) -> Float[Tensor, "*B P 4 4"]:
        """normalised_T_part, translations in normalised units, to metres about `centre`."""
        out = pose.clone()
        out[..., :3, 3] = self.inverse(pose[..., :3, 3])
        return out


def normalise(points: Float[Tensor, "*B N 3"]) -> tuple[Float[Tensor, "*B N 3"], Similarity]:
    """Centre on the centroid and scale to mean radius 0.25.

    Raises:
        ValueError: All points of a cloud coincide, or a coordinate is not finite.
    """
    centre = points.mean(-2)
    radius = (points - centre[..., None, :]).norm(dim=-1).mean(-1)
    # Equal points a metre away have a radius of rounding error, not of 0.
    rounding = 8 * torch.finfo(points.dtype).eps * centre.norm(dim=-1)
    if not bool((torch.isfinite(radius) & (radius > rounding)).all()):
        odd = ~torch.isfinite(points)
        if bool(odd.any()):
            what = "NaN" if bool(torch.isnan(points).any()) else "infinite"
            raise ValueError(
                f"cloud: expected finite points, found {int(odd.any(-1).sum())} of "
                f"{odd[..., 0].numel()} with {what} coordinates"
            )
        raise ValueError(
            "cloud: expected finite points that differ, found mean radius "
            f"{radius.flatten().tolist()[:8]} about {centre.reshape(-1, 3).tolist()[:8]}"
        )
    similarity = Similarity(scale=MEAN_RADIUS / radius, centre=centre)
    return similarity.forward(points), similarity


def ends(values: Tensor, dim: int = 0) -> Tensor:
    """(2, ...): the ends of each coordinate along `dim`, but for single points beyond (`SPAN`)."""
    return values.quantile(torch.tensor(SPAN).to(values), dim)


def fibonacci_sphere(count: int) -> Float[Tensor, "{count} 3"]:
    """Unit vectors spread over the sphere, from z down: the first half are those of a half sphere.

    >>> fibonacci_sphere(1000).mean(0).norm().item() < 1e-3
    True
    """
    number = torch.arange(count) + 0.5
    height, angle = 1 - 2 * number / count, torch.pi * (1 + 5**0.5) * number
    radius = (1 - height.square()).sqrt()
    return torch.stack([angle.cos() * radius, angle.sin() * radius, height], 1)
