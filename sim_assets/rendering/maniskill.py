# SPDX-License-Identifier: MIT
"""ManiSkill as a renderer: many objects and views at once, each in a sub-scene of its own.

No environment and no simulation: a `ManiSkillScene` whose sub-scenes hold a kinematic actor per
part and one for the camera (one that is fixed has the same pose in all sub-scenes). Actors and not
articulations, so that parts stand exactly where `sapien` puts them: a rounded pose would now and
then win or lose a pixel, and so change which points are drawn. The shader is SAPIEN's `trivial`,
whose positions are metres in float32; ManiSkill's own configurations give whole millimetres.

On a CUDA device PhysX keeps all poses in one buffer there, from which the renderers take them
(`RenderSystemGroup.set_cuda_poses`); all pictures are taken in one call and reduced to depth and
part before they are fetched. This way follows ManiSkill 3.0.1's source and has not been run on a
GPU yet. Elsewhere the sub-scenes are drawn in turn, which is tested against `sapien`.
"""

from __future__ import annotations

import gc
import warnings
from collections.abc import Sequence
from importlib import import_module, metadata
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from scapo.geometry.camera import Intrinsics
from sim_assets.objects import ArticulatedObject
from sim_assets.rendering.base import (
    BACKGROUND,
    AbstractParallelRenderer,
    Frame,
    RenderError,
    RenderRequest,
)
from sim_assets.rendering.sapien import (
    camera_pose,
    depth_range,
    find_device,
    find_reach,
    make_shapes,
)

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of the packages that they bring
    import sapien
    from sapien import physx

    BackendInfo = import_module("mani_skill.envs.utils.system.backend").BackendInfo
    ManiSkillScene = import_module("mani_skill.envs.scene").ManiSkillScene
    ShaderConfig = import_module("mani_skill.render.shaders").ShaderConfig
    Camera = import_module("mani_skill.sensors.camera").Camera
    CameraConfig = import_module("mani_skill.sensors.camera").CameraConfig
    Actor = import_module("mani_skill.utils.structs").Actor
    Pose = import_module("mani_skill.utils.structs.pose").Pose

TEXTURES = {"Position": ["position"], "Segmentation": ["segmentation"], "Color": ["rgb"]}
"""Of the shader `trivial`, as ManiSkill names what they hold."""
CAPACITY_CUDA, CAPACITY_CPU = 64, 4
NEAR, FAR = 0.05, 100.0
"""Planes on CUDA in units of the object's reach; a camera group's cameras are set up once."""
AWAY = 1e4
"""Where a part is put that is not to be seen, m: beyond every far plane."""


def versions() -> dict[str, str]:
    """Of ManiSkill and SAPIEN, and the device they draw on."""
    return {
        "mani_skill": metadata.version("mani_skill"),
        "sapien": sapien.__version__,
        "device": find_device().name,
    }


class ManiSkillRenderer(AbstractParallelRenderer):
    """Renders with ManiSkill; see `AbstractParallelRenderer`."""

    def __init__(self, *, color: bool = False, capacity: int | None = None) -> None:
        """Look the device up.

        Args:
            color: Whether frames have colours.
            capacity: Objects at once; None for a number that suits the device.

        Raises:
            RenderError: No device renders here.
        """
        self.device = find_device()
        self.cuda = bool(self.device.is_cuda())
        self.color = color
        self.capacity = capacity or (CAPACITY_CUDA if self.cuda else CAPACITY_CPU)
        self.things: tuple[ArticulatedObject, ...] = ()
        self.sub_scenes: _SubScenes | None = None

    def open(self, thing: ArticulatedObject) -> None:
        """See `AbstractRenderer.open`."""
        self.open_all([thing])

    def open_all(self, things: Sequence[ArticulatedObject]) -> None:
        """See `AbstractParallelRenderer.open_all`; the scenes are made with the first picture."""
        self.close()
        self.things = tuple(things)

    def render(
        self,
        state: Float[np.ndarray, " J"],
        camera_T_object: Float[np.ndarray, "4 4"],
        camera: Intrinsics,
        only: int | None = None,
    ) -> Frame:
        """See `AbstractRenderer.render`."""
        if len(self.things) != 1:
            raise RenderError(f"expected one open object, found {len(self.things)}")
        request = RenderRequest(
            state=state, camera_T_object=camera_T_object, camera=camera, only=only
        )
        return next(frame for frame in self.render_all([request]) if frame is not None)

    def render_all(self, requests: Sequence[RenderRequest | None]) -> list[Frame | None]:
        """See `AbstractParallelRenderer.render_all`."""
        if len(requests) != len(self.things):
            raise RenderError(
                f"expected a request for each of {len(self.things)}, found {len(requests)}"
            )
        cameras = {request.camera for request in requests if request is not None}
        if not cameras:
            return [None] * len(requests)
        if len(cameras) > 1:
            raise RenderError(
                f"expected the same intrinsics in all sub-scenes, found {len(cameras)}"
            )
        (camera,) = cameras
        try:
            if self.sub_scenes is None or self.sub_scenes.intrinsics != camera:
                self.sub_scenes = _SubScenes(self.device, self.things, camera, self.color)
            self.sub_scenes.place(requests)
            return self.sub_scenes.capture(requests)
        except RuntimeError as error:
            raise RenderError(f"ManiSkill: {error}") from error

    def close(self) -> None:
        """Drop the scenes with all they hold."""
        self.things, shown, self.sub_scenes = (), self.sub_scenes is not None, None
        if shown:
            gc.collect()  # ManiSkill's scenes and cameras hold each other, and the device's memory


class _SubScenes:
    """A sub-scene per object: an actor per part and one that carries the camera."""

    def __init__(
        self,
        device: Any,  # noqa: ANN401
        things: tuple[ArticulatedObject, ...],
        camera: Intrinsics,
        color: bool,
    ) -> None:
        self.things, self.intrinsics, self.color = things, camera, color
        self.names = list(TEXTURES) if color else list(TEXTURES)[:2]
        self.cuda = bool(device.is_cuda())
        self.scene = _make_scene(device, len(things))
        self.reach = [find_reach(thing) for thing in things]
        self.actors = self._add_parts()
        self.parts = Actor.merge(self.actors, name="parts")
        self.eyes = _kinematic(self.scene, "eye", list(range(len(things))))
        if self.cuda:  # before the cameras, which ask for their places in PhysX's buffer
            self.scene.px.gpu_init()
            self.scene.px.cuda_rigid_body_data.torch()[:, 7:] = 0  # velocities
        self.sensor = self._add_cameras()

    def _add_parts(self) -> list[Any]:
        """In order of sub-scene and part; shapes of an object in several sub-scenes are shared."""
        shapes: dict[int, list[list[Any]]] = {}
        actors = []
        for number, thing in enumerate(self.things):
            made = shapes.get(id(thing))
            if made is None:
                made = shapes[id(thing)] = [make_shapes(v, self.color) for v in thing.visuals]
            else:
                made = [[shape.clone() for shape in part] for part in made]
            for part, surfaces in enumerate(made):
                actor = _kinematic(self.scene, f"object{number}part{part}", [number], surfaces)
                found = actor._objs[0].per_scene_id
                if found != part + 1:
                    raise RenderError(f"expected entity {part + 1}, found {found}")
                actors.append(actor)
        return actors

    def _add_cameras(self) -> Any:  # noqa: ANN401
        names = {name: TEXTURES[name] for name in self.names}
        config = CameraConfig(
            uid="eye",
            pose=sapien.Pose(),
            width=self.intrinsics.width,
            height=self.intrinsics.height,
            fov=1.0,  # until the next lines
            mount=self.eyes,
            shader_config=ShaderConfig("trivial", texture_names=names),
        )
        sensor = Camera(config, self.scene)
        self.scene.sensors["eye"] = sensor
        for camera, reach in zip(sensor.camera._render_cameras, self.reach, strict=True):
            _set_intrinsics(camera, self.intrinsics, (NEAR * reach, FAR * reach))
        return sensor

    def place(self, requests: Sequence[RenderRequest | None]) -> None:
        """Put parts and cameras where the requests say; sub-scenes without one stay."""
        parts = []
        for thing, request in zip(self.things, requests, strict=True):
            count = len(thing.visuals)
            parts += [None] * count if request is None else _part_poses(thing, request)
        eyes = [
            None if request is None else camera_pose(request.camera_T_object)
            for request in requests
        ]
        for actor, poses in ((self.parts, parts), (self.eyes, eyes)):
            if self.cuda:
                _move_on_device(actor, poses)
                continue
            for entity, pose in zip(actor._objs, poses, strict=True):
                if pose is not None:
                    entity.set_pose(pose)

    def capture(self, requests: Sequence[RenderRequest | None]) -> list[Frame | None]:
        """The pictures."""
        return self._capture_at_once(requests) if self.cuda else self._capture_in_turn(requests)

    def _capture_at_once(self, requests: Sequence[RenderRequest | None]) -> list[Frame | None]:
        """All pictures on the device, fetched as depth, part and colour."""
        self.scene.update_render()
        self.sensor.capture()
        taken = self.sensor.camera.get_picture(self.names)
        pictures = dict(zip(self.names, taken, strict=True))
        entity = pictures["Segmentation"].view(torch.int32)[..., 1]  # torch knows little unsigned
        depth = torch.where(entity > 0, -pictures["Position"][..., 2], 0.0).cpu().numpy()
        part = ((entity - 1) & BACKGROUND).to(torch.uint8).cpu().numpy()
        color = None
        if self.color:
            shade = (pictures["Color"][..., :3] * 255 + 0.5).clamp(0, 255)
            color = shade.to(torch.uint8).cpu().numpy()
        return [
            None
            if request is None
            else Frame(depth=depth[i], part=part[i], color=None if color is None else color[i])
            for i, request in enumerate(requests)
        ]

    def _capture_in_turn(self, requests: Sequence[RenderRequest | None]) -> list[Frame | None]:
        frames: list[Frame | None] = []
        cameras = zip(self.scene.sub_scenes, self.sensor.camera._render_cameras, strict=True)
        for (scene, camera), reach, request in zip(cameras, self.reach, requests, strict=True):
            if request is None:
                frames.append(None)
                continue
            _set_intrinsics(camera, request.camera, depth_range(request.camera_T_object, reach))
            scene.update_render()
            camera.take_picture()
            part = camera.get_picture("Segmentation")[..., 1].astype(np.uint8) - np.uint8(1)
            z = camera.get_picture("Position")[..., 2]
            depth = np.where(part == BACKGROUND, 0, -z).astype(np.float32)
            shade = camera.get_picture("Color")[..., :3] if self.color else None
            color = None if shade is None else np.clip(shade * 255 + 0.5, 0, 255).astype(np.uint8)
            frames.append(Frame(depth=depth, part=part, color=color))
        return frames


def _make_scene(device: Any, count: int) -> Any:  # noqa: ANN401
    """A ManiSkill scene of empty sub-scenes, all at the origin: nothing in them can collide."""
    kind = "cuda" if device.is_cuda() else "cpu"
    systems: list[Any] = [physx.PhysxCpuSystem() for _ in range(count)] if kind == "cpu" else []
    if kind == "cuda":
        if not physx.is_gpu_enabled():
            physx.enable_gpu()
        systems = [physx.PhysxGpuSystem(device=device)] * count
    scenes = [sapien.Scene([system, sapien.render.RenderSystem(device)]) for system in systems]
    if kind == "cuda":
        for scene in scenes:
            systems[0].set_scene_offset(scene, [0.0, 0.0, 0.0])
    where = torch.device(kind)
    backend = BackendInfo(
        device=where,
        sim_device=device if kind == "cuda" else sapien.Device("cpu"),
        sim_backend=f"physx_{kind}",
        render_device=device,
        render_backend=f"sapien_{kind}",
    )
    return ManiSkillScene(scenes, device=where, backend=backend)


def _kinematic(scene: Any, name: str, numbers: list[int], shapes: Sequence[Any] = ()) -> Any:  # noqa: ANN401
    """An actor that is only moved, in each of some sub-scenes."""
    builder = scene.create_actor_builder()
    builder.set_scene_idxs(numbers)
    builder._procedural_shapes = list(shapes)
    rest = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]] * len(numbers), device=scene.device)
    builder.initial_pose = Pose.create(rest, device=scene.device)
    return builder.build_kinematic(name)


def _part_poses(thing: ArticulatedObject, request: RenderRequest) -> list[Any]:
    poses = [sapien.Pose(object_T_part) for object_T_part in thing.pose(request.state)]
    if request.only is None:
        return poses
    away = sapien.Pose([0, 0, AWAY])
    return [pose if part == request.only else away for part, pose in enumerate(poses)]


def _move_on_device(actor: Any, poses: Sequence[Any]) -> None:  # noqa: ANN401
    """Write the poses that are given into PhysX's buffer."""
    moved = [i for i, pose in enumerate(poses) if pose is not None]
    rows = np.stack([np.concatenate([poses[i].p, poses[i].q]) for i in moved])
    index = actor._body_data_index.long()[moved]
    actor.px.cuda_rigid_body_data.torch()[index, :7] = torch.from_numpy(rows).to(actor.device)


def _set_intrinsics(camera: Any, intrinsics: Intrinsics, planes: tuple[float, float]) -> None:  # noqa: ANN401
    camera.set_perspective_parameters(
        *planes, intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, 0.0
    )
