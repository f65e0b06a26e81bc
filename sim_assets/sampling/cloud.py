# SPDX-License-Identifier: MIT
"""From a picture to a labelled cloud in the camera frame: points, parts, poses, joints, visibility.

Points are computed in float64 from the float32 depth and rounded once, so a point mapped back by
its part's pose lies on that part's surface to a few micrometres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from scapo.geometry.camera import Intrinsics
from scapo.geometry.matrices import moved
from sim_assets.models.textures import Paint
from sim_assets.objects import ArticulatedObject
from sim_assets.options import Sampling
from sim_assets.rendering.base import Frame, pixel_rays
from sim_assets.sampling.viewpoints import generator

SURFACE_SAMPLES = 512
"""Per part, for `visible`: its standard error is 0.02 or less."""
FPS_POOL = 16
TOLERANCE = 1e-3
"""Of the object's diagonal: how far from the picture's surface a surface sample counts as seen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cloud:
    """Points drawn from one or more pictures."""

    points: Float[np.ndarray, "N 3"]
    """Camera frame, m."""
    part: UInt8[np.ndarray, " N"]
    color: UInt8[np.ndarray, "N 3"] | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """Poses and joints in the camera frame."""

    camera_T_part: Float[np.ndarray, "P 4 4"]
    pivot: Float[np.ndarray, "J 3"]
    axis: Float[np.ndarray, "J 3"]
    state: Float[np.ndarray, " J"]


def truth(
    thing: ArticulatedObject,
    state: Float[np.ndarray, " J"],
    camera_T_object: Float[np.ndarray, "4 4"],
) -> Truth:
    """What is known of the object at this state, in the camera frame.

    A joint's pivot and axis move with its parent, so that
    camera_T_child = camera_T_parent @ motion(pivot, axis, state), both in the parent's frame.
    """
    poses = camera_T_object @ thing.pose(state)
    parents = [joint.parent for joint in thing.category.joints]
    turn, shift = poses[parents, :3, :3], poses[parents, :3, 3]
    return Truth(
        camera_T_part=poses,
        pivot=(turn @ thing.pivot[..., None])[..., 0] + shift,
        axis=(turn @ thing.axis[..., None])[..., 0],
        state=state,
    )


def visible_pixels(frames: list[Frame]) -> list[Int[np.ndarray, " _"]]:
    """Flat indices of the pixels that show the object, or what is taken for it, per picture."""
    return [np.flatnonzero(frame.depth > 0) for frame in frames]


def sample_frames(
    frames: list[Frame],
    seen: list[Int[np.ndarray, " _"]],
    camera: Intrinsics,
    count: int,
    rng: np.random.Generator,
    sampling: Sampling,
) -> Cloud:
    """Draw `count` visible pixels of one picture, or of one picture per part, as points.

    Without replacement where there are enough pixels. Only drawn pixels are back-projected,
    unless the sampling needs all of them.

    Args:
        frames: One picture of the whole object, or one per part.
        seen: Their `visible_pixels`.
        camera: Intrinsics.
        count: Points wanted.
        rng: Where chance comes from.
        sampling: How to choose.
    """
    pixel = np.concatenate(seen)
    source = np.repeat(np.arange(len(frames)), [len(index) for index in seen])
    if sampling == "random":
        chosen = choose(len(pixel), count, rng)
        pixel, source = pixel[chosen], source[chosen]
    points = _back_project(frames, source, pixel, camera)
    if sampling == "fps":
        chosen = choose_far(points, count, rng)
        points, pixel, source = points[chosen], pixel[chosen], source[chosen]
    part = _pick([frame.part.ravel() for frame in frames], source, pixel)
    colors = [frame.color.reshape(-1, 3) for frame in frames if frame.color is not None]
    color = _pick(colors, source, pixel) if colors else None
    return Cloud(points=points.astype(np.float32), part=part, color=color)


def choose(available: int, count: int, rng: np.random.Generator) -> Int[np.ndarray, " N"]:
    """Indices drawn without replacement; with it where there are fewer than `count`."""
    if available < count:
        return rng.integers(available, size=count)
    return rng.choice(available, count, replace=False)


def choose_far(
    points: Float[np.ndarray, "K 3"], count: int, rng: np.random.Generator
) -> Int[np.ndarray, " N"]:
    """Indices by farthest-point sampling from a random start; filled up by random ones.

    From FPS_POOL times as many points as wanted, drawn at random, where there are more: that makes
    no visible difference and is as much faster as there are more.
    """
    import torch  # seconds, in each worker, of which few need it

    from scapo.geometry.points import farthest_points

    if len(points) > FPS_POOL * count:
        pool = choose(len(points), FPS_POOL * count, rng)
        return pool[choose_far(points[pool], count, rng)]
    start = int(rng.integers(len(points)))
    far = farthest_points(torch.from_numpy(points), min(count, len(points)), start=start).numpy()
    return np.concatenate([far, rng.integers(len(points), size=count - len(far))])


def _pick(
    images: list[np.ndarray], source: Int[np.ndarray, " ..."], pixel: Int[np.ndarray, " ..."]
) -> np.ndarray:
    if len(images) == 1:
        return images[0][pixel]
    return np.stack(images)[source, pixel]


def _back_project(
    frames: list[Frame],
    source: Int[np.ndarray, " N"],
    pixel: Int[np.ndarray, " N"],
    camera: Intrinsics,
) -> Float[np.ndarray, "N 3"]:
    z = _pick([frame.depth.ravel() for frame in frames], source, pixel).astype(np.float64)
    return pixel_rays(camera)[pixel] * z[:, None]


class SurfaceSamples:
    """Points drawn uniformly by area from each part's surface, for `visible` and `full` clouds."""

    def __init__(self, thing: ArticulatedObject, *, color: bool = False) -> None:
        self.meshes = [thing.part_mesh(part) for part in range(len(thing.visuals))]
        drawn = [
            sample_surface(mesh, SURFACE_SAMPLES, generator("surface", thing.instance, part))
            for part, mesh in enumerate(self.meshes)
        ]
        self.points = np.stack([points for points, _ in drawn])  # (P, K, 3)
        self.normals = np.stack(
            [mesh.face_normals[face] for mesh, (_, face) in zip(self.meshes, drawn, strict=True)]
        )
        self._both = np.concatenate([self.points, self.normals], 1)
        self.paints = [Paint(visuals) for visuals in thing.visuals] if color else []
        self.areas = np.array([mesh.area for mesh in self.meshes])
        self.tolerance = TOLERANCE * float(np.linalg.norm(thing.extents()))

    def visible(
        self,
        frames: list[Frame],
        camera: Intrinsics,
        camera_T_part: Float[np.ndarray, "P 4 4"],
    ) -> Float[np.ndarray, " P"]:
        """Share of each part's surface that the picture shows.

        A surface sample is seen if the pixel it falls in shows its part at the depth of the
        sample's tangent plane on that pixel's ray, within TOLERANCE. Using the plane makes the
        test exact on flat surfaces at any slant, and tells the two sides of a thin panel apart.

        Args:
            frames: One picture of the whole object, or one per part.
            camera: Intrinsics.
            camera_T_part: Poses.
        """
        turned = (self._both @ camera_T_part[:, :3, :3].transpose(0, 2, 1)).transpose(2, 0, 1)
        nx, ny, nz = turned[:, :, SURFACE_SAMPLES:]
        x, y, z = turned[:, :, :SURFACE_SAMPLES] + camera_T_part[:, :3, 3].T[:, :, None]
        ahead = np.maximum(z, 1e-9)
        u = np.floor(x / ahead * camera.fx + camera.cx)
        v = np.floor(y / ahead * camera.fy + camera.cy)
        inside = (z > 1e-9) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        pixel = np.where(inside, v * camera.width + u, 0).astype(np.intp)
        ray_x = (u + 0.5 - camera.cx) / camera.fx
        ray_y = (v + 0.5 - camera.cy) / camera.fy
        along = ray_x * nx + ray_y * ny + nz
        plane = (x * nx + y * ny + z * nz) / np.where(along == 0, 1e-12, along)
        image = np.arange(len(pixel))[:, None] % len(frames)  # one for all, or one per part
        label = _pick([frame.part.ravel() for frame in frames], image, pixel)
        depth = _pick([frame.depth.ravel() for frame in frames], image, pixel)
        seen = inside & (label == np.arange(len(pixel))[:, None])
        seen &= np.abs(plane - depth) <= self.tolerance
        return seen.mean(-1)

    def sample(
        self,
        camera_T_part: Float[np.ndarray, "P 4 4"],
        count: int,
        least: int,
        rng: np.random.Generator,
        sampling: Sampling = "random",
    ) -> Cloud:
        """`count` points of the whole posed surface (`--protocol full`), uniform by area.

        A part that would get fewer than `least` points gets that many.
        """
        dense = 4 * count if sampling == "fps" else count
        share = np.maximum(self.areas / self.areas.sum(), 1.5 * least / count)
        number = np.maximum(rng.multinomial(dense, share / share.sum()), least)
        number[number.argmax()] += dense - number.sum()
        points, colors = [], []
        for p, (mesh, pose, n) in enumerate(zip(self.meshes, camera_T_part, number, strict=True)):
            drawn, face = sample_surface(mesh, int(n), rng)
            points.append(moved(drawn, pose))
            if self.paints:
                colors.append(self.paints[p].colors(face, drawn))
        part = np.repeat(np.arange(len(number), dtype=np.uint8), number)
        every = np.concatenate(points)
        chosen = choose_far(every, count, rng) if sampling == "fps" else rng.permutation(count)
        return Cloud(
            points=every[chosen].astype(np.float32),
            part=part[chosen],
            color=np.concatenate(colors)[chosen] if colors else None,
        )


def sample_surface(
    mesh: trimesh.Trimesh, count: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "{count} 3"], Int[np.ndarray, " {count}"]]:
    """Points uniform by area, and the face of each."""
    total = np.cumsum(mesh.area_faces)
    face = np.searchsorted(total, rng.uniform(0, total[-1], count), side="right")
    face = np.minimum(face, len(total) - 1)
    u, v = rng.uniform(size=(2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    a, b, c = (mesh.vertices[mesh.faces[face, k]] for k in range(3))
    return np.asarray(a + u * (b - a) + v * (c - a)), face
