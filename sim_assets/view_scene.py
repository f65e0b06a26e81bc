# SPDX-License-Identifier: MIT
"""A sample and its object in a viser scene.

Everything hangs below one node, the camera frame; turning that node shows the scene as the object
stands (z up) or as the camera sees it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from sim_assets.articulated import ArticulatedObject

AXIS = (17, 17, 17)
FRUSTUM = (120, 120, 120)
CAMERA, OBJECT = "/camera", "/camera/object"
FROM_FRONT, FROM_CAMERA = np.array([-1.0, -0.75, 0.6]), np.array([0.0, 0.0, -1.0])
"""Where a browser looks from, in units of the cloud's size."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """One sample, camera frame."""

    points: Float[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]
    camera_T_object: Float[np.ndarray, "4 4"]
    pivot: Float[np.ndarray, "J 3"]
    axis: Float[np.ndarray, "J 3"]
    camera: Float[np.ndarray, " 6"]

    @property
    def placed(self) -> bool:
        """Whether the object's pose is known."""
        return bool(np.isfinite(self.camera_T_object).all())

    @property
    def reach(self) -> float:
        """Longest side of the box around the middle 98 % of the points, m."""
        low, high = np.quantile(self.points, (0.01, 0.99), axis=0)
        return max(float((high - low).max()), 1e-3)


@dataclass(slots=True, kw_only=True, eq=False)
class Stage:
    """What is in the scene, by kind, so that it can be hidden and moved."""

    scene: Any
    """Of a viser server."""
    cloud: list[Any] = field(default_factory=list)
    axes: list[Any] = field(default_factory=list)
    camera: list[Any] = field(default_factory=list)
    parts: list[Any] = field(default_factory=list)
    """A frame per part of the object, above its meshes."""
    meshes: list[Any] = field(default_factory=list)

    def draw(self, shown: Shown, upright: bool) -> None:
        """Put a sample in the place of the one before; `upright` in the object frame."""
        upright = upright and shown.placed
        self.scene.set_up_direction("+z" if upright else "-y")
        self._frame(CAMERA, np.linalg.inv(shown.camera_T_object) if upright else np.eye(4))
        if shown.placed:
            self._frame(OBJECT, shown.camera_T_object)
        reach = shown.reach
        points = self.scene.add_point_cloud(
            f"{CAMERA}/cloud",
            shown.points,
            shown.colors,
            point_size=0.008 * reach,
            point_shape="circle",
            precision="float32",
            point_shading="flat",
        )
        self.cloud = [points]
        for handle in self.axes:
            handle.remove()
        pairs = zip(shown.pivot, shown.axis, strict=True)
        self.axes = [
            self._arrow(f"{CAMERA}/axis{j}", pivot, axis, reach)
            for j, (pivot, axis) in enumerate(pairs)
            if np.isfinite([pivot, axis]).all()
        ]
        self.camera = [self._frustum(shown.camera, reach)] if shown.camera[1] > 0 else []

    def load(self, thing: ArticulatedObject | None, opacity: float) -> None:
        """Show this object from now on, or none."""
        self.scene.remove_by_name(OBJECT)
        self.parts, self.meshes = [], []
        if thing is None:
            return
        self._frame(OBJECT, np.eye(4))
        for p, visuals in enumerate(thing.visuals):
            self.parts.append(self.scene.add_frame(f"{OBJECT}/part{p}", show_axes=False))
            for k, visual in enumerate(visuals):
                mesh = self.scene.add_mesh_simple(
                    f"{OBJECT}/part{p}/mesh{k}",
                    np.asarray(visual.mesh.vertices, np.float32),
                    np.asarray(visual.mesh.faces, np.uint32),
                    color=tuple(round(255 * c) for c in visual.color[:3]),
                    opacity=opacity,
                    flat_shading=True,
                    side="double",
                )
                self.meshes.append(mesh)

    def pose(self, poses: Float[np.ndarray, "P 4 4"]) -> None:
        """Put the object's parts there, object frame."""
        for handle, pose in zip(self.parts, poses, strict=True):
            _place(handle, pose)

    def _frame(self, name: str, pose: Float[np.ndarray, "4 4"]) -> None:
        handle = self.scene.get_handle_by_name(name)
        if handle is None:
            handle = self.scene.add_frame(name, show_axes=False)
        _place(handle, pose)

    def _arrow(
        self,
        name: str,
        pivot: Float[np.ndarray, " 3"],
        axis: Float[np.ndarray, " 3"],
        reach: float,
    ) -> Any:  # noqa: ANN401
        ends = np.stack([pivot - 0.4 * reach * axis, pivot + 0.6 * reach * axis])
        return self.scene.add_arrows(
            name,
            ends[None],
            AXIS,
            shaft_radius=0.005 * reach,
            head_radius=0.016 * reach,
            head_length=0.05 * reach,
        )

    def _frustum(self, camera: Float[np.ndarray, " 6"], reach: float) -> Any:  # noqa: ANN401
        _, fy, _, _, width, height = camera.tolist()
        return self.scene.add_camera_frustum(
            f"{CAMERA}/frustum",
            fov=2 * math.atan(height / (2 * fy)),
            aspect=width / height,
            scale=0.1 * reach,
            thickness=0.004 * reach,
            color=FRUSTUM,
        )


def look(camera: Any, shown: Shown, upright: bool) -> None:  # noqa: ANN401
    """Where browsers that connect look from: from the front, or from the camera's side."""
    centre = np.median(shown.points, axis=0).astype(float)
    upright = upright and shown.placed
    if upright:
        object_T_camera = np.linalg.inv(shown.camera_T_object)
        centre = object_T_camera[:3, :3] @ centre + object_T_camera[:3, 3]
    offset = FROM_FRONT if upright else FROM_CAMERA
    camera.up = (0.0, 0.0, 1.0) if upright else (0.0, -1.0, 0.0)
    camera.look_at = tuple(centre)
    camera.position = tuple(centre + 1.2 * shown.reach * offset)


def _place(handle: Any, pose: Float[np.ndarray, "4 4"]) -> None:  # noqa: ANN401
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    handle.wxyz, handle.position = (w, x, y, z), tuple(pose[:3, 3])
