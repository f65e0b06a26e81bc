# SPDX-License-Identifier: MIT
"""SAPIEN as a renderer: one scene per object, one camera that is moved, depth and part read back.

SAPIEN's own `trivial` shader writes three pictures of four channels; ours (`shaders/depth`) writes
one with depth and entity, in less than half the time. SAPIEN draws only
front faces, so surfaces that are not closed are drawn twice, once reversed.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from scapo.geometry.camera import Intrinsics
from sim_assets.models.textures import one_per_side, read_texels, texture_of
from sim_assets.objects import ArticulatedObject, Visual
from sim_assets.rendering.base import BACKGROUND, AbstractRenderer, Frame, RenderError

os.environ.setdefault("LP_NUM_THREADS", "1")  # of Mesa's CPU driver: one process per core is faster
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import sapien
    from sapien.render import (
        RenderBodyComponent,
        RenderCameraComponent,
        RenderMaterial,
        RenderShapeTriangleMesh,
        RenderTexture2D,
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
        found = _device(name)
        if isinstance(found, sapien.Device):
            return found
        reasons.append(found)
    raise RenderError(f"expected a Vulkan device for SAPIEN, found none ({'; '.join(reasons[:2])})")


def _device(name: str) -> sapien.Device | str:
    """The device if it renders, else why not."""
    try:
        device = sapien.Device(name)
    except RuntimeError as error:
        return str(error)
    return device if device.can_render() else f"{name} cannot render"


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
        self.scene: _Scene | None = None

    def open(self, thing: ArticulatedObject) -> None:
        """A new scene for each object: one whose objects are exchanged grows in memory.

        The old scene goes only when the new one is there, since SAPIEN makes what scenes share
        anew, in 20 ms, when there was none left.
        """
        self.scene = _Scene(self.device, thing, self.color)

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
        self.scene.pose(state)
        self.scene.show(only)
        self.scene.aim(camera_T_object, camera)
        return self.scene.capture()

    def close(self) -> None:
        """Drop the scene with all it holds."""
        self.scene = None


class _Scene:
    """A scene with one object: an entity per part, and a camera."""

    def __init__(self, device: sapien.Device, thing: ArticulatedObject, color: bool) -> None:
        self.thing, self.color = thing, color
        self.scene = sapien.Scene([sapien.render.RenderSystem(device)])
        self.parts = [_entity(visuals, color) for visuals in thing.visuals]
        for entity in self.parts:
            self.scene.add_entity(entity)
        ids = [entity.per_scene_id for entity in self.parts]
        if ids != list(range(1, len(ids) + 1)):
            raise RenderError(f"expected entities numbered 1, 2, ..., found {ids}")
        self.hidden: frozenset[int] = frozenset()
        self.reach = find_reach(thing)
        self.size = (0, 0)
        self.eye = sapien.Entity()
        self.camera: Any = None
        """A component of `eye`, made anew when the picture's size changes."""

    def pose(self, state: Float[np.ndarray, " J"]) -> None:
        for entity, object_T_part in zip(self.parts, self.thing.pose(state), strict=True):
            entity.set_pose(sapien.Pose(object_T_part))

    def show(self, only: int | None) -> None:
        parts = frozenset(range(len(self.parts)))
        hidden = frozenset[int]() if only is None else parts - {only}
        for part in hidden ^ self.hidden:
            component = self.parts[part].components[0]
            component.disable() if part in hidden else component.enable()
        self.hidden = hidden

    def aim(self, camera_T_object: Float[np.ndarray, "4 4"], camera: Intrinsics) -> None:
        if self.size != (camera.width, camera.height):
            self._make_camera(camera)
        self.eye.set_pose(camera_pose(camera_T_object))
        near, far = depth_range(camera_T_object, self.reach)
        self.camera.set_perspective_parameters(
            near, far, camera.fx, camera.fy, camera.cx, camera.cy, 0.0
        )

    def capture(self) -> Frame:
        self.scene.update_render()
        self.camera.take_picture()
        if not self.color:
            surface = self.camera.get_picture("Surface")
            depth = np.ascontiguousarray(surface.view(np.float32)[..., 0])
            return Frame(depth=depth, part=_part(surface[..., 1].astype(np.uint8)))
        part = _part(self.camera.get_picture("Segmentation")[..., 1].astype(np.uint8))
        z = self.camera.get_picture("Position")[..., 2]
        depth = np.where(part == BACKGROUND, 0, -z).astype(np.float32)
        color = np.clip(self.camera.get_picture("Color")[..., :3] * 255 + 0.5, 0, 255)
        return Frame(depth=depth, part=part, color=color.astype(np.uint8))

    def _make_camera(self, camera: Intrinsics) -> None:
        if self.camera is not None:
            self.scene.remove_entity(self.eye)
            self.eye = sapien.Entity()
        self.size = (camera.width, camera.height)
        shader = COLOR_SHADER if self.color else SHADER
        self.camera = RenderCameraComponent(*self.size, str(shader))
        self.eye.add_component(self.camera)
        self.scene.add_entity(self.eye)


def camera_pose(camera_T_object: Float[np.ndarray, "4 4"]) -> sapien.Pose:
    """Of SAPIEN's camera (x forward, y left, z up) in the object frame."""
    turn, shift = camera_T_object[:3, :3].T, camera_T_object[:3, 3]
    object_T_robot = np.eye(4)
    object_T_robot[:3, :3] = turn @ CAMERA_T_ROBOT
    object_T_robot[:3, 3] = -turn @ shift
    return sapien.Pose(object_T_robot)


def depth_range(camera_T_object: Float[np.ndarray, "4 4"], reach: float) -> tuple[float, float]:
    """Near and far, m: tight, which keeps surfaces a fraction of a millimetre apart in order."""
    distance = math.hypot(*camera_T_object[:3, 3])
    return max(distance - 1.1 * reach, 0.02 * distance, 1e-4), distance + 1.1 * reach


def _part(entity: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Parts are entities 1, 2, ...; 0, where there is none, becomes 255."""
    return entity - np.uint8(1)


def _entity(visuals: tuple[Visual, ...], color: bool) -> sapien.Entity:
    """A part as one entity."""
    body = RenderBodyComponent()
    for shape in make_shapes(visuals, color):
        body.attach(shape)
    entity = sapien.Entity()
    entity.add_component(body)
    return entity


def make_shapes(visuals: tuple[Visual, ...], color: bool) -> list[RenderShapeTriangleMesh]:
    """A part's surfaces: a shape per colour or texture, or one for all, which is one draw call."""
    faces = [np.asarray(visual.mesh.faces) for visual in visuals]
    closed = _closed(visuals)
    if not color:
        starts = np.cumsum([0] + [len(visual.mesh.vertices) for visual in visuals[:-1]])
        every = np.concatenate([part + start for part, start in zip(faces, starts, strict=True)])
        both = every if closed else np.concatenate([every, every[:, ::-1]])
        return [_shape(visuals, both, RenderMaterial())]
    textures: dict[int, RenderTexture2D] = {}
    return [
        _shape([visual], shown, _material(visual, textures))
        for visual, shown in zip(visuals, faces if closed else one_per_side(visuals), strict=True)
        if len(shown)
    ]


def _material(visual: Visual, textures: dict[int, RenderTexture2D]) -> RenderMaterial:
    """Of one visual; `textures` are those that the device has already, by material."""
    made = RenderMaterial()
    made.base_color = [*visual.color]
    found = texture_of(visual)
    if found is None:
        return made
    name = id(found.material)
    if name not in textures:
        texels = read_texels(found.material)
        if texels is None:
            return made
        opaque = np.pad(texels, ((0, 0), (0, 0), (0, 1)), constant_values=255)
        # sRGB all along, as flat colours are; one level, as in `textures.look_up`.
        textures[name] = RenderTexture2D(opaque, "R8G8B8A8Unorm")
    made.base_color_texture = textures[name]
    return made


def find_reach(thing: ArticulatedObject) -> float:
    """Radius about the object's origin that no point of it leaves at any state, m."""
    radius = np.zeros(len(thing.visuals))
    for part, visuals in enumerate(thing.visuals):
        corners = np.concatenate([trimesh.bounds.corners(v.mesh.bounds) for v in visuals])
        radius[part] = np.linalg.norm(corners, axis=1).max()
    for j, joint in enumerate(thing.category.joints):
        # About an axis a point moves at most twice as far as it is from the pivot.
        turning = joint.kind == "revolute"
        extra = 2 * np.linalg.norm(thing.pivot[j]) if turning else thing.upper[j]
        radius[joint.child] += extra
    return float(radius.max())


def _closed(visuals: Sequence[Visual]) -> bool:
    """Whether every edge is met once each way and each surface encloses a positive volume."""
    for visual in visuals:
        corners, faces = np.asarray(visual.mesh.vertices), np.asarray(visual.mesh.faces)
        start, end = faces.ravel(), faces[:, (1, 2, 0)].ravel()
        there, back = (np.sort(a * len(corners) + b) for a, b in ((start, end), (end, start)))
        if not np.array_equal(there, back) or (there[1:] == there[:-1]).any():
            return False
        if np.linalg.det(corners[faces]).sum() <= 0:
            return False
    return True


def _shape(
    visuals: Sequence[Visual], faces: Int[np.ndarray, "F 3"], material: RenderMaterial
) -> RenderShapeTriangleMesh:
    """Surfaces as one shape; faces count their vertices one after the other."""
    points = np.concatenate([visual.mesh.vertices for visual in visuals]).astype(np.float32)
    return RenderShapeTriangleMesh(
        vertices=points,
        triangles=faces.astype(np.uint32),
        normals=np.zeros_like(points),
        uvs=np.concatenate([_coordinates(visual) for visual in visuals]),
        material=material,
    )


def _coordinates(visual: Visual) -> Float[np.ndarray, "V 2"]:
    """Of the texture, v downwards."""
    found = texture_of(visual)
    if found is None:
        return np.zeros((len(visual.mesh.vertices), 2), np.float32)
    uv = np.asarray(found.uv, float)
    return np.stack([uv[:, 0], 1 - uv[:, 1]], -1).astype(np.float32)
