# SPDX-License-Identifier: MIT
"""Closed meshes of parts from scattered points with normals, sparse, noisy and incomplete.

The solid is what a ball that rolls over the points from outside cannot reach (an alpha shape:
H. Edelsbrunner, E. P. Mücke, Three-dimensional alpha shapes, 1994), and no thinner than the grid
can show. That needs no trust in the normals' sense: a plate that is thinner than its points are
apart stays a plate, and an object whose back nobody saw stays a shell. Normals only smooth and
densify the points. The mesh is a level set in tetrahedra, closed by construction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from jaxtyping import Float, Int
from manifold3d import Manifold, Mesh64
from scipy.ndimage import binary_fill_holes, maximum_filter
from scipy.spatial import KDTree

from bench.twin.level_set import level_set

MAX_FACES = 4000
MAX_SAMPLES = 4000
"""Points of a part that are used; more are thinned evenly."""
NEIGHBOURS = 16
"""Points that tell a normal."""
SPACING = 0.9
"""Quantile of the distances to the third nearest point that counts as the points' spacing."""
LEAST_SPACING = 0.005
"""Of the part's diagonal: repeated points are no finer sampling."""
NOISY = 0.25
"""Spacings of the model's samples, from which noise on observed ones is worse than none of them."""
DENSER = 0.4
"""Spacings of the model's samples, to which observed points are thinned."""
OUTLIER = 0.1
"""Of the model's diagonal: observed points farther off its samples are no part of the object."""
REACH = 1.6
"""Radius of the ball, in spacings: gaps up to twice as wide are closed."""
FINE = 3.5
"""Cells of the grid in a spacing."""
NODES = 150_000
"""Of the grid at most, which is coarser where the part is large."""
THIN, SOLID = 0.8, 0.2
"""Cells that are added on all sides: to what is thinner than a cell or so, and to the rest."""
COARSER = 1.4
"""Factor on the cells while there are too many faces."""
DUST = 0.02
"""Share of the volume below which a piece that hangs on nothing is left out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples:
    """Points of one part's surface in the part's frame, m."""

    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    """Unit."""
    noise: float = 0.0
    """m, how far points lie off the plane through their neighbours, as a rule."""
    spacing: float = 0.0
    """m, how far they are apart where they are sparse; where the points tell more, that holds."""

    def thinned(self, count: int) -> Samples:
        """At most so many, evenly from their order."""
        if len(self.points) <= count:
            return self
        index = np.linspace(0, len(self.points) - 1, count).astype(int)
        return replace(self, points=self.points[index], normals=self.normals[index])


def seen_samples(points: Float[np.ndarray, "N 3"], camera: Float[np.ndarray, " 3"]) -> Samples:
    """Observed points of a part; normals across their neighbours, towards the camera.

    Args:
        points: m, at least one.
        camera: Its centre in the same frame.
    """
    thin = Samples(points=points, normals=points).thinned(MAX_SAMPLES).points
    count = min(NEIGHBOURS, len(thin))
    around = thin[_nearest(KDTree(thin), thin, count)[1]]
    around = around - around.mean(1, keepdims=True)
    spread, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normal, noise = vectors[..., 0], float(np.median(np.maximum(spread[:, 0], 0)) / count) ** 0.5
    away = ((camera - thin) * normal).sum(-1, keepdims=True) < 0
    return Samples(points=thin, normals=np.where(away, -normal, normal), noise=noise)


def joined(model: Samples, seen: Samples) -> Samples:
    """A model's samples, replaced by observed ones where there are some that face the same way.

    Of a sensor that is too noisy for the model's spacing none are taken, nor what is far from it.
    Observed points are thinned to the model's spacing: by that of a dense depth image, what nobody
    saw would have holes.
    """
    if not len(seen.points) or not len(model.points):
        return seen if len(seen.points) else model
    spacing = _spacing(model.points)
    diagonal = float(np.linalg.norm(np.ptp(model.points, axis=0)))
    near = _nearest(KDTree(model.points), seen.points, 1)[0][:, 0] < OUTLIER * diagonal
    if seen.noise > NOISY * spacing or not near.any():
        return model
    cells = np.floor(seen.points[near] / (DENSER * spacing)).astype(int)
    kept = np.flatnonzero(near)[np.sort(np.unique(cells, axis=0, return_index=True)[1])]
    seen = Samples(points=seen.points[kept], normals=seen.normals[kept])
    gap, index = _nearest(KDTree(seen.points), model.points, 1)
    alike = (seen.normals[index[:, 0]] * model.normals).sum(-1) > 0.5
    kept = ~((gap[:, 0] < spacing) & alike)
    return Samples(
        points=np.concatenate([model.points[kept], seen.points]),
        normals=np.concatenate([model.normals[kept], seen.normals]),
        spacing=spacing,
    )


def closed_mesh(samples: Samples) -> trimesh.Trimesh:
    """A closed mesh about the samples, wound counter-clockwise from outside, `MAX_FACES` at most.

    Equal input gives an equal mesh.

    Args:
        samples: At least one, finite.

    Raises:
        ValueError: No samples.
    """
    if not len(samples.points):
        raise ValueError("surface: expected at least one point, found none")
    few = samples.thinned(MAX_SAMPLES)
    centre, turn = _principal(few.points)
    local = Samples(points=(few.points - centre) @ turn, normals=few.normals @ turn)
    spacing = max(_spacing(local.points), samples.spacing)
    dense = _densified(_densified(_smoothed(local, spacing))).points
    wanted = spacing / FINE
    while True:
        low, count, cell = _grid(dense, REACH * spacing, wanted)
        made = _simple(_depth(dense, REACH * spacing, (low, count, cell)))
        if made.num_tri() <= MAX_FACES:
            break
        wanted = COARSER * cell
    mesh = made.to_mesh64()
    vertices = low + cell * np.asarray(mesh.vert_properties, float)[:, :3]
    vertices = vertices @ turn.T + centre
    return trimesh.Trimesh(vertices, np.asarray(mesh.tri_verts, np.int64), process=False)


def _principal(
    points: Float[np.ndarray, "N 3"],
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Centre and principal axes (columns, a rotation), along which the grid is least."""
    centre = points.mean(0)
    axes = np.linalg.eigh((points - centre).T @ (points - centre))[1]
    axes[:, 0] *= np.linalg.det(axes)
    return centre, axes


def _nearest(
    tree: KDTree, points: Float[np.ndarray, "N 3"], count: int
) -> tuple[Float[np.ndarray, "N K"], Int[np.ndarray, "N K"]]:
    """Distances and indices, with a last axis for one neighbour too."""
    distance, index = tree.query(points, k=count)
    return np.reshape(distance, (-1, count)), np.reshape(index, (-1, count))


def _spacing(points: Float[np.ndarray, "N 3"]) -> float:
    """How far samples are apart, m, greater than 0."""
    distance = _nearest(KDTree(points), points, min(4, len(points)))[0][:, -1]
    least = LEAST_SPACING * float(np.linalg.norm(np.ptp(points, axis=0)))
    return max(float(np.quantile(distance, SPACING)), least, 1e-4)


def _smoothed(samples: Samples, spacing: float) -> Samples:
    """Points moved along their normals onto the plane through neighbours that face alike."""
    points, normals = samples.points, samples.normals
    distance, index = _nearest(KDTree(points), points, min(NEIGHBOURS, len(points)))
    off = ((points[index] - points[:, None]) * normals[:, None]).sum(-1)
    alike = ((normals[index] * normals[:, None]).sum(-1) > 0.7) & (np.abs(off) < spacing / 2)
    alike[:, 0] = True
    weight = np.exp(-0.5 * (distance / spacing) ** 2) * alike
    move = (weight * off).sum(1, keepdims=True) / weight.sum(1, keepdims=True)
    return Samples(points=points + normals * move, normals=normals)


def _densified(samples: Samples) -> Samples:
    """With the middles between neighbours on one flat piece of surface; none beyond its rim."""
    points, normals = samples.points, samples.normals
    index = _nearest(KDTree(points), points, min(7, len(points)))[1][:, 1:]
    pairs = np.stack([np.repeat(np.arange(len(points)), index.shape[1]), index.ravel()], -1)
    a, b = np.unique(np.sort(pairs, axis=1), axis=0).T
    step = points[b] - points[a]
    least = 0.3 * np.linalg.norm(step, axis=1)
    flat = (normals[a] * normals[b]).sum(-1) > 0.8
    flat &= np.abs((step * normals[a]).sum(-1)) < least
    flat &= np.abs((step * normals[b]).sum(-1)) < least
    a, b = a[flat], b[flat]
    normal = normals[a] + normals[b]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Samples(
        points=np.concatenate([points, (points[a] + points[b]) / 2]),
        normals=np.concatenate([normals, normal]),
    )


def _simple(depth: Float[np.ndarray, "X Y Z"]) -> Manifold:
    """Where the depth at the nodes is above 0, in cells; without dust, simplified."""
    made = _without_dust(Manifold(Mesh64(*level_set(depth))))
    tolerance = 0.05
    simple = made.simplify(tolerance)
    while simple.num_tri() > MAX_FACES and tolerance < 0.5:
        tolerance *= COARSER
        simple = made.simplify(tolerance)
    return _without_dust(simple)


def _without_dust(made: Manifold) -> Manifold:
    pieces = made.decompose()
    volume = np.array([piece.volume() for piece in pieces])
    kept = [p for p, v in zip(pieces, volume, strict=True) if v > DUST * volume.sum()]
    return Manifold.compose(kept)


Grid = tuple[Float[np.ndarray, " 3"], Int[np.ndarray, " 3"], float]
"""First node, nodes along each axis, cell; m."""


def _grid(points: Float[np.ndarray, "N 3"], radius: float, cell: float) -> Grid:
    size = np.ptp(points, axis=0) + 2 * radius
    cell = max(cell, float((np.prod(size) / NODES) ** (1 / 3)))
    low = points.min(0) - radius - 2 * cell
    return low, np.ceil(size / cell).astype(int) + 5, cell


def _depth(points: Float[np.ndarray, "N 3"], radius: float, grid: Grid) -> np.ndarray:
    """How deep each node lies in the solid, in cells; below 0 outside.

    Within `radius` of the points is where the ball's centre cannot go; as far from that rim as
    the radius is where the ball does not reach. Cavities that are closed are filled.
    """
    low, count, cell = grid
    nodes = low + cell * np.indices(tuple(count)).reshape(3, -1).T
    tree = KDTree(points)
    gap, near = map(np.asarray, tree.query(nodes, distance_upper_bound=radius + 2 * cell))
    inside = np.asarray(binary_fill_holes((gap < radius).reshape(count))).ravel()
    rim = np.flatnonzero(~inside & (gap < radius + 1.8 * cell))
    at = points[near[rim]]
    edge = KDTree(at + (nodes[rim] - at) * (radius / gap[rim])[:, None])
    most = radius + 2 * cell
    depth = np.full(len(nodes), -cell)
    depth[inside] = np.minimum(edge.query(nodes[inside], distance_upper_bound=most)[0], most)
    depth = (depth.reshape(count) - radius) / cell
    solid = np.clip(maximum_filter(depth, 5) - 0.5, 0, 1)
    return depth + THIN + (SOLID - THIN) * solid
