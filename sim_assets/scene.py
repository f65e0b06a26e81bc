# SPDX-License-Identifier: MIT
"""SAPIEN as a renderer: one scene per object, one camera that is moved, depth and part read back.

SAPIEN's own `trivial` shader is exact but writes three pictures; ours (`shaders/depth`) writes one
with depth and entity, and takes about half the time. SAPIEN draws only front faces, so surfaces
that are not closed are drawn twice, once reversed.
"""

from __future__ import annotations

import os
import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from scapo.camera import Intrinsics
from sim_assets.articulated import ArticulatedObject, Visual
from sim_assets.renderer import BACKGROUND, AbstractRenderer, Frame, RenderError

os.environ.setdefault("LP_NUM_THREADS", "1")  # of Mesa's CPU driver: one process per core is faster
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import sapien
    from sapien.render import (
        RenderBodyComponent,
        RenderCameraComponent,
        RenderMaterial,
        RenderShapeTriangleMesh,
    )

SHADER = Path(__file__).parent / "shaders" / "depth"
COLOR_SHADER = Path(sapien.__file__).parent / "vulkan_shader" / "trivial"
CAMERA_T_ROBOT = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""SAPIEN's camera axes (x forward, y left, z up) in the OpenCV frame."""


@lru_cache(maxsize=1)
def find_device() -> sapien.Device:
    """The device to render on: CUDA where there is one, else any Vulkan device.

    Raises:
        RenderError: There is none.
    """
    reasons = []
    for name in ("cuda", *(f"pci:{i}" for i in range(4))):
        try:
            device = sapien.Device(name)
            if device.can_render():
                return device
            reasons.append(f"{name} cannot render")
        except RuntimeError as error:
            reasons.append(str(error))
    raise RenderError(f"expected a Vulkan device for SAPIEN, found none ({reasons[0]})")


def versions() -> dict[str, str]:
    """Of SAPIEN, and the device it draws on."""
    return {"sapien": sapien.__version__, "device": find_device().name}


class SapienRenderer(AbstractRenderer):
    """Renders with SAPIEN; see `AbstractRenderer`."""

    def __init__(self, *, color: bool = False) -> None:
        """Look the device up.

        Raises:
            RenderError: No device renders here.
        """
        self.device = find_device()
        self.color = color
        self.scene: sapien.Scene | None = None

    def open(self, thing: ArticulatedObject) -> None:
        """A new scene with one entity per part: reused scenes grow in memory."""
        self.close()
        self.object = thing
        scene = sapien.Scene([sapien.render.RenderSystem(self.device)])
        scene.set_ambient_light([1, 1, 1])
        self.parts = [self._entity(visuals) for visuals in thing.visuals]
        for entity in self.parts:
            scene.add_entity(entity)
        ids = [entity.per_scene_id for entity in self.parts]
        self.part_of_id = np.full(max(ids) + 1, BACKGROUND, np.uint8)
        self.part_of_id[ids] = np.arange(len(ids))
        self.radius = np.linalg.norm(np.stack(_corners(thing)), axis=-1).max()
        self.scene, self.camera, self.size = scene, None, (0, 0)
        self.hidden: frozenset[int] = frozenset()

    def render(
        self,
        state: Float[np.ndarray, " J"],
        camera_T_object: Float[np.ndarray, "4 4"],
        camera: Intrinsics,
        only: int | None = None,
    ) -> Frame:
        """See `AbstractRenderer.render`."""
        if self.scene is None:
            raise RenderError("expected an open object, found none")
        for entity, object_T_part in zip(self.parts, self.object.pose(state), strict=True):
            entity.set_pose(sapien.Pose(object_T_part))
        self._show(only)
        self._aim(camera_T_object, camera)
        self.scene.update_render()
        self.camera.take_picture()
        return self._read()

    def close(self) -> None:
        """Drop the scene with all it holds."""
        self.scene = self.camera = None
        self.parts = []

    def _entity(self, visuals: tuple[Visual, ...]) -> sapien.Entity:
        body = RenderBodyComponent()
        if self.color:
            for visual in visuals:
                body.attach(_shape(*_double_sided(visual.mesh), visual.color))
        else:  # one draw call per part
            body.attach(_shape(*_merged([_double_sided(visual.mesh) for visual in visuals])))
        entity = sapien.Entity()
        entity.add_component(body)
        return entity

    def _show(self, only: int | None) -> None:
        hidden = frozenset() if only is None else frozenset(range(len(self.parts))) - {only}
        for part in hidden ^ self.hidden:
            component = self.parts[part].components[0]
            component.disable() if part in hidden else component.enable()
        self.hidden = hidden

    def _aim(self, camera_T_object: Float[np.ndarray, "4 4"], camera: Intrinsics) -> None:
        if self.camera is None or self.size != (camera.width, camera.height):
            self._add_camera(camera)
        object_T_camera = np.linalg.inv(camera_T_object)
        object_T_robot = np.eye(4)
        object_T_robot[:3, :3] = object_T_camera[:3, :3] @ CAMERA_T_ROBOT
        object_T_robot[:3, 3] = object_T_camera[:3, 3]
        self.eye.set_pose(sapien.Pose(object_T_robot))
        # A tight depth range keeps surfaces a fraction of a millimetre apart in order.
        distance = float(np.linalg.norm(camera_T_object[:3, 3]))
        near = max(distance - 2 * self.radius, 0.02 * distance, 1e-4)
        self.camera.set_perspective_parameters(
            near, distance + 2 * self.radius, camera.fx, camera.fy, camera.cx, camera.cy, 0.0
        )

    def _add_camera(self, camera: Intrinsics) -> None:
        if self.camera is not None:
            self.scene.remove_entity(self.eye)
        shader = COLOR_SHADER if self.color else SHADER
        self.camera = RenderCameraComponent(camera.width, camera.height, str(shader))
        self.size = (camera.width, camera.height)
        self.eye = sapien.Entity()
        self.eye.add_component(self.camera)
        self.scene.add_entity(self.eye)

    def _read(self) -> Frame:
        position = self.camera.get_picture("Position")
        if not self.color:
            part = self.part_of_id[position[..., 1].astype(np.intp)]
            return Frame(depth=np.ascontiguousarray(position[..., 0]), part=part)
        entity = self.camera.get_picture("Segmentation")[..., 1]
        part = self.part_of_id[entity.astype(np.intp)]
        depth = np.where(part == BACKGROUND, 0, -position[..., 2]).astype(np.float32)
        color = np.clip(self.camera.get_picture("Color")[..., :3] * 255 + 0.5, 0, 255)
        return Frame(depth=depth, part=part, color=color.astype(np.uint8))


def _corners(thing: ArticulatedObject) -> list[Float[np.ndarray, "K 3"]]:
    """Where the object may reach: corners of every surface at rest and with all joints open."""
    boxes = []
    for fraction in (0.0, 0.5, 1.0):
        for visuals, pose in zip(thing.visuals, thing.pose(fraction * thing.upper), strict=True):
            for visual in visuals:
                box = trimesh.bounds.corners(visual.mesh.bounds)
                boxes.append(box @ pose[:3, :3].T + pose[:3, 3])
    return [np.concatenate(boxes)]


def _double_sided(
    mesh: trimesh.Trimesh,
) -> tuple[Float[np.ndarray, "V 3"], np.ndarray]:
    """Vertices and faces, with reversed faces added unless the surface is closed and outward."""
    faces = np.asarray(mesh.faces)
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        faces = np.concatenate([faces, faces[:, ::-1]])
    return np.asarray(mesh.vertices), faces


def _merged(
    surfaces: list[tuple[np.ndarray, np.ndarray]],
) -> tuple[Float[np.ndarray, "V 3"], np.ndarray]:
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in surfaces[:-1]])
    faces = [faces + start for (_, faces), start in zip(surfaces, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in surfaces]), np.concatenate(faces)


def _shape(
    vertices: Float[np.ndarray, "V 3"],
    faces: np.ndarray,
    color: tuple[float, ...] = (0.7, 0.7, 0.7, 1.0),
) -> RenderShapeTriangleMesh:
    material = RenderMaterial()
    material.base_color = list(color)
    points = vertices.astype(np.float32)
    return RenderShapeTriangleMesh(
        vertices=points,
        triangles=faces.astype(np.uint32),
        normals=np.zeros_like(points),
        uvs=np.zeros((len(points), 2), np.float32),
        material=material,
    )
