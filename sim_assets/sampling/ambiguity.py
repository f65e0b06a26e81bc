# SPDX-License-Identifier: MIT
"""Which turns of an object look as the object does: poses that nobody could tell apart.

For each of the 24 turns of a cube, applied to the base about its box's centre, placement and joint
states are fitted again (`turned_fit`), the turned object is rendered, and both depth images are
compared both ways: every observed pixel must show a surface of the turned object, and no surface of
it may be where the camera saw through. So poses are told apart by what is seen, as in V. Drost et
al.: BOP-Distrib, arXiv 2408.17297, here with joints.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.optimize import linear_sum_assignment

from scapo.geometry.camera import Intrinsics
from sim_assets.objects import ArticulatedObject
from sim_assets.options import Noise
from sim_assets.rendering.base import BACKGROUND, Frame
from sim_assets.sampling.cloud import pixel_rays
from sim_assets.sampling.turned_fit import NEAR, TURNS, Body, Fit, Oriented
from sim_assets.sensors.disparity import depth_sigma
from sim_assets.sensors.kinect import axial_sigma
from sim_assets.sensors.surface import incidence, surface

PROBES = 96
"""Observed points of the coarse search; also samples of each part's surface."""
FITTED = 256
"""Observed points of the fit."""
COVERED, STICKING_OUT = 0.85, 0.1
"""Of a turn that is fitted: the least share of probes near its surface, and the largest share of
its surface that would stand where the camera saw through."""
MARGIN = 10
"""Pixels around the object's image."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerance:
    """When a turned object explains an image."""

    size: float = 0.01
    """Depth may differ by this share of the object's diagonal: clouds of 1,024 points have a
    spacing of some 3 % of what they show."""
    sigmas: float = 3.0
    """Or by this many standard deviations of the sensor's noise, where that is more."""
    share: float = 0.003
    """Of the pixels of either image that the other may leave unexplained: 3 of 1,024 points."""
    pixels: int = 128
    """Longer side of the object's image when compared; surfaces may differ by one pixel across."""


CHOSEN = Tolerance()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alike:
    """The turns that look as the truth does; at all others the fields hold the truth."""

    turns: UInt8[np.ndarray, " 24"]
    """1 where the turn looks alike; the first, no turn, always does."""
    camera_T_base: Float[np.ndarray, "24 4 4"]
    state: Float[np.ndarray, "24 J"]
    part: UInt8[np.ndarray, "24 P"]
    """The true part in whose place part p of the turned object stands."""
    unexplained: Float[np.ndarray, " 24"]
    """Larger share of both images that the other leaves unexplained; 1 where none was compared."""

    def row(self) -> dict[str, np.ndarray]:
        """The tensors of a sample (docs/data-format.md)."""
        return {
            "alike": self.turns,
            "alike_base": self.camera_T_base.astype(np.float32),
            "alike_state": self.state.astype(np.float32),
            "alike_part": self.part,
        }


class Ambiguity:
    """Finds the turns of one object that look alike, view by view."""

    def __init__(
        self,
        thing: ArticulatedObject,
        camera: Intrinsics,
        noise: Noise = "none",
        tolerance: Tolerance = CHOSEN,
    ) -> None:
        """Prepare the object's surfaces; a view then takes tens of milliseconds.

        Args:
            thing: The object.
            camera: Intrinsics of the views: what is outside their images is not seen.
            noise: Of the sensor.
            tolerance: When a turned object explains an image.
        """
        from sim_assets.rendering.embree import RaycastRenderer  # not on every machine

        self.thing, self.camera, self.noise, self.tolerance = thing, camera, noise, tolerance
        self.body = Body(thing)
        self.renderer = RaycastRenderer(rebuild_below=0)
        self.renderer.open(thing)

    def find(
        self, state: Float[np.ndarray, " J"], camera_T_object: Float[np.ndarray, "4 4"]
    ) -> Alike:
        """The turns that explain the depth image of this view.

        Args:
            state: Joint states, rad or m.
            camera_T_object: Where the object stands; part 0 is the object frame.
        """
        view = _View(self, state, camera_T_object)
        starts = self.body.starts(_eye(camera_T_object))
        alike = _truth(self.thing, state, camera_T_object)
        seen = view.oriented(FITTED)
        for turn, index in view.candidates(starts):
            for moves in (False, True):  # the exact turn first
                fit = self.body.fit(seen, starts[turn], index, moves=moves)
                if fit is None:
                    continue
                frame = view.render(fit)
                share = view.unexplained(frame)
                alike.unexplained[turn] = min(share, alike.unexplained[turn])
                if share <= self.tolerance.share:
                    alike.turns[turn] = 1
                    alike.camera_T_base[turn] = camera_T_object @ fit.object_T_turned
                    alike.state[turn] = fit.state
                    alike.part[turn] = _stand_ins(view.frame, frame, len(self.thing.visuals))
                    break
        return alike

    def within(self, depth: Float[np.ndarray, "H W"], camera: Intrinsics) -> np.ndarray:
        """The difference in depth that each pixel allows, m."""
        least = np.float32(self.tolerance.size * self.body.size)
        z = np.maximum(depth, np.float32(1e-3))
        if self.noise == "none":
            return np.full(depth.shape, least)
        sigma = depth_sigma(z)
        if self.noise == "kinect":
            angle = np.where(depth > 0, incidence(surface(depth), camera).reshape(depth.shape), 0)
            sigma = axial_sigma(z, angle)
        return np.maximum(least, self.tolerance.sigmas * sigma)


class _View:
    """One observed depth image, without noise, and what it says of other surfaces."""

    def __init__(
        self,
        owner: Ambiguity,
        state: Float[np.ndarray, " J"],
        camera_T_object: Float[np.ndarray, "4 4"],
    ) -> None:
        self.owner, self.camera_T_object = owner, camera_T_object
        self.camera = _close_up(owner, state, camera_T_object)
        self.frame = owner.renderer.render(state, camera_T_object, self.camera)
        self.seen = np.flatnonzero(self.frame.depth > 0)
        self.within = owner.within(self.frame.depth, self.camera)

    def points(self, count: int) -> Float[np.ndarray, "_ 3"]:
        """Observed points, evenly spread over the pixels; object frame."""
        return self._at(_evenly(self.seen, count))

    def oriented(self, count: int) -> Oriented:
        """Half of them evenly over the pixels, half evenly over the parts, with their normals."""
        label = self.frame.part.ravel()[self.seen]
        parts = np.unique(label)
        pixel = [_evenly(self.seen, count // 2)]
        pixel += [_evenly(self.seen[label == p], count // 2 // len(parts)) for p in parts]
        at = np.concatenate(pixel)
        shown, rays, camera = surface(self.frame.depth, at), pixel_rays(self.camera)[at], self.camera
        # On the plane n . X = d the inverse depth is n . (x, y, 1) / d.
        across, down = shown.slope_u * camera.fx, shown.slope_v * camera.fy
        rest = shown.inverse - rays[:, 0] * across - rays[:, 1] * down
        normal = -np.stack([across, down, rest], -1) @ self.camera_T_object[:3, :3]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.concatenate([self._at(at), normal], 1)

    def _at(self, pixel: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M 3"]:
        points = pixel_rays(self.camera)[pixel] * self.frame.depth.ravel()[pixel, None]
        pose = self.camera_T_object
        return (points - pose[:3, 3]) @ pose[:3, :3]

    def candidates(
        self, starts: Float[np.ndarray, "T 4 4"]
    ) -> list[tuple[int, tuple[int, ...]]]:
        """Turns but the first that may explain the image, with their best states' indices."""
        body = self.owner.body
        cover = body.cover(self.points(PROBES), starts)
        outside = self._outside(starts)
        joints = len(body.states)
        out = outside[0].reshape(-1, *[1] * joints)
        for j, share in enumerate(outside[1:]):
            out = out + share.reshape(len(starts), *[-1 if i == j else 1 for i in range(joints)])
        score = np.where(
            (cover >= COVERED) & (out / len(outside) <= STICKING_OUT), cover - out / len(outside), -1
        ).reshape(len(starts), -1)
        best = score.argmax(1)
        return [
            (turn, tuple(int(i) for i in np.unravel_index(best[turn], cover.shape[1:])))
            for turn in range(1, len(starts))
            if score[turn, best[turn]] >= 0
        ]

    def _outside(self, starts: Float[np.ndarray, "T 4 4"]) -> list[np.ndarray]:
        """Share of each part's surface that would stand where the camera saw through."""
        depth = np.where(self.frame.depth > 0, self.frame.depth, np.inf)
        size = self.owner.body.size
        reach = 2 * int(np.ceil(NEAR * size * self.camera.fx / np.median(depth.flat[self.seen]))) + 1
        first = minimum_filter(depth, reach, mode="nearest") - NEAR * size
        shares = []
        for points in self.owner.body.posed(starts, PROBES):
            pose, camera = self.camera_T_object, self.camera
            x, y, z = np.moveaxis(points @ pose[:3, :3].T + pose[:3, 3], -1, 0)
            ahead = np.maximum(z, 1e-6)
            u = np.floor(x / ahead * camera.fx + camera.cx).astype(np.intp)
            v = np.floor(y / ahead * camera.fy + camera.cy).astype(np.intp)
            inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
            limit = first[np.clip(v, 0, camera.height - 1), np.clip(u, 0, camera.width - 1)]
            shares.append(np.where(inside, z < limit, ~self._beyond(x / ahead, y / ahead)).mean(-1))
        return shares

    def _beyond(self, x: np.ndarray, y: np.ndarray) -> Bool[np.ndarray, "*B"]:
        """Outside the true camera's image."""
        camera = self.owner.camera
        u, v = x * camera.fx + camera.cx, y * camera.fy + camera.cy
        return (u < 0) | (v < 0) | (u > camera.width) | (v > camera.height)

    def render(self, fit: Fit) -> Frame:
        """The turned object by the same camera."""
        pose = self.camera_T_object @ fit.object_T_turned
        return self.owner.renderer.render(fit.state, pose, self.camera)

    def unexplained(self, frame: Frame) -> float:
        """The larger share of both images that the other does not explain."""
        there = self.owner.within(frame.depth, self.camera)
        return max(
            _unexplained(self.frame.depth, frame.depth, self.within),
            _unexplained(frame.depth, self.frame.depth, there),
        )


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
    owner: Ambiguity, state: Float[np.ndarray, " J"], camera_T_object: Float[np.ndarray, "4 4"]
) -> Intrinsics:
    """Intrinsics of the part of the image that shows the object, at the resolution compared."""
    poses = camera_T_object @ owner.thing.pose(state)
    corners = np.concatenate(
        [s[:, :3] @ p[:3, :3].T + p[:3, 3] for s, p in zip(owner.body.surfaces, poses, strict=True)]
    )
    camera = owner.camera
    z = np.maximum(corners[:, 2], 1e-6)
    u = np.clip(corners[:, 0] / z * camera.fx + camera.cx, 0, camera.width)
    v = np.clip(corners[:, 1] / z * camera.fy + camera.cy, 0, camera.height)
    scale = owner.tolerance.pixels / max(np.ptp(u), np.ptp(v), 1e-6)
    low = np.maximum([u.min() - MARGIN / scale, v.min() - MARGIN / scale], 0)
    high = np.minimum(
        [u.max() + MARGIN / scale, v.max() + MARGIN / scale], [camera.width, camera.height]
    )
    width, height = (max(int(side), 1) for side in np.floor((high - low) * scale))
    return Intrinsics(
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx - float(low[0])) * scale,
        cy=(camera.cy - float(low[1])) * scale,
        width=width,
        height=height,
    )


def _truth(
    thing: ArticulatedObject,
    state: Float[np.ndarray, " J"],
    camera_T_object: Float[np.ndarray, "4 4"],
) -> Alike:
    count, parts = len(TURNS), len(thing.visuals)
    unexplained = np.ones(count)
    unexplained[0] = 0
    return Alike(
        turns=(np.arange(count) == 0).astype(np.uint8),
        camera_T_base=np.tile(camera_T_object, (count, 1, 1)),
        state=np.tile(state, (count, 1)),
        part=np.tile(np.arange(parts, dtype=np.uint8), (count, 1)),
        unexplained=unexplained,
    )


def _stand_ins(observed: Frame, turned: Frame, parts: int) -> Int[np.ndarray, " P"]:
    """The true part in whose place each part of the turned object is seen, one to one."""
    both = (observed.part != BACKGROUND) & (turned.part != BACKGROUND)
    pairs = turned.part[both].astype(np.intp) * parts + observed.part[both]
    shared = np.bincount(pairs, minlength=parts * parts).reshape(parts, parts) + 0.5 * np.eye(parts)
    return linear_sum_assignment(shared, maximize=True)[1]


def _eye(camera_T_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 3"]:
    return -camera_T_object[:3, :3].T @ camera_T_object[:3, 3]
