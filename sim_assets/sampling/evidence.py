# SPDX-License-Identifier: MIT
"""What is seen of an object, and how much of it the object explains when it stands otherwise.

Both ways: what is seen must lie on a surface of the object, and no surface of it may be where
nothing was seen.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Integer
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.optimize import linear_sum_assignment

from scapo.geometry.camera import Intrinsics
from scapo.geometry.matrices import moved
from sim_assets.options import Noise
from sim_assets.rendering.base import BACKGROUND, AbstractRenderer
from sim_assets.sampling.turned_fit import CLOSE, NEAR, Body, Fit, Oriented
from sim_assets.sampling.viewpoints import generator
from sim_assets.sensors.disparity import depth_sigma
from sim_assets.sensors.kinect import axial_sigma
from sim_assets.sensors.surface import incidence, surface

MARGIN = 10
"""Pixels around the object's image."""
WHOLE = 2048
"""Points of each of two whole surfaces that are compared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerance:
    """When an object that stands otherwise explains what is seen."""

    size: float = 0.01
    """Surfaces may differ by this share of the object's diagonal: clouds of 1,024 points have a
    spacing of some 3 % of what they show."""
    sigmas: float = 3.0
    """Or by this many standard deviations of the sensor's noise, where that is more."""
    share: float = 0.003
    """Of what is seen, and of what would be seen, that may stay unexplained: 3 of 1,024 points."""
    pixels: int = 128
    """Longer side of the object's image when compared; surfaces may differ by one pixel across."""


class AbstractEvidence(ABC):
    """Of one sample. Points are in the object frame of the true placement."""

    @abstractmethod
    def points(self, count: int) -> Float[np.ndarray, "_ 3"]:
        """Points of what is seen, evenly spread."""

    @abstractmethod
    def oriented(self, count: int) -> Oriented:
        """Half of them evenly spread, half evenly over the parts, with their normals."""

    @abstractmethod
    def outside(self, starts: Float[np.ndarray, "T 4 4"], count: int) -> list[np.ndarray]:
        """Share of each part's surface, of `count` points, that would stand where nothing is.

        Of the base (T,), of the others (T, K) at each of the body's states.
        """

    @abstractmethod
    def unexplained(self, fit: Fit) -> tuple[float, Int[np.ndarray, " P"]]:
        """The share unexplained, the larger of both ways, and whose place each part takes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """Who looks at an object."""

    camera: Intrinsics
    """What is outside its images is not seen."""
    noise: Noise
    """Of the sensor."""
    tolerance: Tolerance
    renderer: AbstractRenderer
    """With the object open."""

    def within(
        self, depth: Float[np.ndarray, "H W"], camera: Intrinsics, size: float
    ) -> Float[np.ndarray, "H W"]:
        """The difference in depth that each pixel allows, m; `size` is the object's diagonal."""
        least = np.full(depth.shape, np.float32(self.tolerance.size * size))
        z = np.maximum(depth, np.float32(1e-3))
        if self.noise == "none":
            return least
        sigma = depth_sigma(z)
        if self.noise == "kinect":
            sigma = axial_sigma(z, incidence(surface(depth), camera).reshape(depth.shape))
        return np.maximum(least, np.where(depth > 0, self.tolerance.sigmas * sigma, 0))


class DepthImage(AbstractEvidence):
    """The depth image of one view, without noise and of the object alone, at a chosen resolution.

    What the mask of a sensor's sample leaves out is taken as seen.
    """

    def __init__(
        self,
        body: Body,
        state: Float[np.ndarray, " J"],
        camera_T_object: Float[np.ndarray, "4 4"],
        sight: Sight,
    ) -> None:
        """Render the true object.

        Args:
            body: Of the object.
            state: Joint states, rad or m.
            camera_T_object: Where it stands.
            sight: Who looks at it.
        """
        self.body, self.camera_T_object, self.sight = body, camera_T_object, sight
        self.camera = _close_up(body, state, camera_T_object, sight)
        self.frame = sight.renderer.render(state, camera_T_object, self.camera)
        self.seen = np.flatnonzero(self.frame.depth > 0)
        self.within = sight.within(self.frame.depth, self.camera, body.size)

    def points(self, count: int) -> Float[np.ndarray, "_ 3"]:
        """See `AbstractEvidence`."""
        return self._at(_evenly(self.seen, count))

    def oriented(self, count: int) -> Oriented:
        """See `AbstractEvidence`; normals face the camera."""
        label = self.frame.part.ravel()[self.seen]
        parts = np.unique(label)
        pixel = [_evenly(self.seen, count // 2)]
        pixel += [_evenly(self.seen[label == p], count // 2 // len(parts)) for p in parts]
        at = np.concatenate(pixel)
        shown, rays, camera = surface(self.frame.depth, at), self._rays(at), self.camera
        # On the plane n . X = d the inverse depth is n . (x, y, 1) / d.
        across, down = shown.slope_u * camera.fx, shown.slope_v * camera.fy
        rest = shown.inverse - rays[:, 0] * across - rays[:, 1] * down
        normal = -np.stack([across, down, rest], -1) @ self.camera_T_object[:3, :3]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.concatenate([self._at(at), normal], 1)

    def _at(self, pixel: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M 3"]:
        points = self._rays(pixel) * self.frame.depth.ravel()[pixel, None]
        pose = self.camera_T_object
        return (points - pose[:3, 3]) @ pose[:3, :3]

    def _rays(self, pixel: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M 3"]:
        v, u = np.divmod(pixel, self.camera.width)
        x = (u + 0.5 - self.camera.cx) / self.camera.fx
        y = (v + 0.5 - self.camera.cy) / self.camera.fy
        return np.stack([x, y, np.ones(len(pixel))], -1)

    def outside(self, starts: Float[np.ndarray, "T 4 4"], count: int) -> list[np.ndarray]:
        """See `AbstractEvidence`: where the camera saw through, give or take NEAR."""
        depth = np.where(self.frame.depth > 0, self.frame.depth, np.inf)
        pose, camera, near = self.camera_T_object, self.camera, NEAR * self.body.size
        reach = int(np.ceil(near * camera.fx / np.median(depth.flat[self.seen])))
        first = minimum_filter(depth, 2 * reach + 1, mode="nearest") - near
        shares = []
        for points in self.body.posed(starts, count):
            x, y, z = np.moveaxis(moved(points, pose), -1, 0)
            ahead = np.maximum(z, 1e-6)
            u = np.floor(x / ahead * camera.fx + camera.cx).astype(np.intp)
            v = np.floor(y / ahead * camera.fy + camera.cy).astype(np.intp)
            inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
            limit = first[np.clip(v, 0, camera.height - 1), np.clip(u, 0, camera.width - 1)]
            shares.append(np.where(inside, z < limit, ~self._beyond(x / ahead, y / ahead)).mean(-1))
        return shares

    def _beyond(self, x: np.ndarray, y: np.ndarray) -> Bool[np.ndarray, "*B"]:
        """Outside the image of the true camera."""
        camera = self.sight.camera
        u, v = x * camera.fx + camera.cx, y * camera.fy + camera.cy
        return (u < 0) | (v < 0) | (u > camera.width) | (v > camera.height)

    def unexplained(self, fit: Fit) -> tuple[float, Int[np.ndarray, " P"]]:
        """See `AbstractEvidence`: of the pixels of both images."""
        pose = self.camera_T_object @ fit.object_T_turned
        frame = self.sight.renderer.render(fit.state, pose, self.camera)
        within = self.sight.within(frame.depth, self.camera, self.body.size)
        share = max(
            _unexplained(self.frame.depth, frame.depth, self.within),
            _unexplained(frame.depth, self.frame.depth, within),
        )
        both = (self.frame.part != BACKGROUND) & (frame.part != BACKGROUND)
        parts = len(self.body.surfaces)
        return share, _stand_ins(self.frame.part[both], frame.part[both], parts)


def _unexplained(
    depth: Float[np.ndarray, "H W"],
    other: Float[np.ndarray, "H W"],
    within: Float[np.ndarray, "H W"],
) -> float:
    """Share of the pixels of one image at whose depth the other has no surface, within a pixel."""
    low = minimum_filter(np.where(other > 0, other, np.inf), 3, mode="nearest")
    high = maximum_filter(np.where(other > 0, other, -np.inf), 3, mode="nearest")
    seen = depth > 0
    right = (depth >= low - within) & (depth <= high + within)
    return float(1 - np.count_nonzero(right & seen) / max(np.count_nonzero(seen), 1))


def _evenly(pixels: Int[np.ndarray, " K"], count: int) -> Int[np.ndarray, " _"]:
    """`count` of them or all, in steps."""
    return pixels[np.linspace(0, len(pixels) - 1, min(count, len(pixels))).astype(np.intp)]


def _close_up(
    body: Body,
    state: Float[np.ndarray, " J"],
    camera_T_object: Float[np.ndarray, "4 4"],
    sight: Sight,
) -> Intrinsics:
    """Intrinsics of the part of the image that shows the object, at the resolution compared."""
    poses = camera_T_object @ body.thing.pose(state)
    surfaces = zip(body.surfaces, poses, strict=True)
    points = np.concatenate([moved(s[:, :3], pose) for s, pose in surfaces])
    camera, z = sight.camera, np.maximum(points[:, 2], 1e-6)
    size = np.array([camera.width, camera.height])
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    at = np.clip(points[:, :2] / z[:, None] * focal + centre, 0, size)
    scale = sight.tolerance.pixels / max(float(np.ptp(at, axis=0).max()), 1e-6)
    low = np.maximum(at.min(0) - MARGIN / scale, 0)
    high = np.minimum(at.max(0) + MARGIN / scale, size)
    width, height = (max(int(side), 1) for side in np.floor((high - low) * scale))
    return Intrinsics(
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx - float(low[0])) * scale,
        cy=(camera.cy - float(low[1])) * scale,
        width=width,
        height=height,
    )


class WholeSurface(AbstractEvidence):
    """The whole posed surface, of which samples of `--protocol full` are drawn."""

    def __init__(self, body: Body, state: Float[np.ndarray, " J"], tolerance: Tolerance) -> None:
        """Draw points of the true surface; a body with dense samples is needed."""
        self.body, self.tolerance = body, tolerance
        self.true = Fit(object_T_turned=np.eye(4), state=state)
        rng = generator("ambiguity", body.thing.instance)
        areas = np.array([mesh.area for mesh in body.meshes])
        counts = np.maximum(rng.multinomial(WHOLE, areas / areas.sum()), 1)
        self.drawn = [body.draw(part, int(count), rng) for part, count in enumerate(counts)]
        self.part = np.repeat(np.arange(len(counts)), counts)
        self.surface = self._posed(self.true)
        self.own = self._open(self.surface, self.true)[0]

    def points(self, count: int) -> Float[np.ndarray, "_ 3"]:
        """See `AbstractEvidence`."""
        return self.surface[_evenly(np.arange(len(self.surface)), count), :3]

    def oriented(self, count: int) -> Oriented:
        """See `AbstractEvidence`."""
        every = np.arange(len(self.surface))
        parts = np.unique(self.part)
        at = [_evenly(every, count // 2)]
        at += [_evenly(every[self.part == p], count // 2 // len(parts)) for p in parts]
        return self.surface[np.concatenate(at)]

    def outside(self, starts: Float[np.ndarray, "T 4 4"], count: int) -> list[np.ndarray]:
        """See `AbstractEvidence`; not looked at before the fit."""
        del count
        joints = [np.zeros((len(starts), motions.shape[0])) for motions in self.body.motions]
        return [np.zeros(len(starts)), *joints]

    def unexplained(self, fit: Fit) -> tuple[float, Int[np.ndarray, " P"]]:
        """See `AbstractEvidence`: more than of the truth, as samples have gaps."""
        missing, part = self._open(self.surface, fit)
        surplus, _ = self._open(self._posed(fit), self.true)
        seen = part >= 0
        parts = len(self.body.surfaces)
        return max(missing, surplus) - self.own, _stand_ins(self.part[seen], part[seen], parts)

    def _posed(self, fit: Fit) -> Oriented:
        poses = fit.object_T_turned @ self.body.thing.pose(fit.state)
        out = []
        for drawn, pose in zip(self.drawn, poses, strict=True):
            points, normals = np.split(drawn, 2, axis=1)
            out.append(np.concatenate([moved(points, pose), normals @ pose[:3, :3].T], 1))
        return np.concatenate(out)

    def _open(self, seen: Oriented, fit: Fit) -> tuple[float, Int[np.ndarray, " M"]]:
        """Share of the points that lie on no surface, and the part on whose surface they lie."""
        size = self.body.size
        used, part, foot, normal = self.body.nearest(seen, fit, 2 * CLOSE * size)
        gap = np.abs(((seen[used, :3] - foot) * normal).sum(1))
        right = gap <= self.tolerance.size * size
        found = np.full(len(seen), -1)
        found[used[right]] = part[right]
        return float((found < 0).mean()), found


def _stand_ins(
    observed: Integer[np.ndarray, " K"], turned: Integer[np.ndarray, " K"], parts: int
) -> Int[np.ndarray, " P"]:
    """The true part in whose place each part of the turned object is, one to one."""
    pairs = turned.astype(np.intp) * parts + observed
    shared = np.bincount(pairs, minlength=parts * parts).reshape(parts, parts) + 0.5 * np.eye(parts)
    return linear_sum_assignment(shared, maximize=True)[1]
