# SPDX-License-Identifier: MIT
"""The same pictures by ray casting on the CPU (Embree): fallback without Vulkan, and test oracle.

Embree says which triangle each ray meets; the depth comes from that triangle's plane in float64.
Small objects are merged in the camera frame and rebuilt for each view; for large ones each part
keeps its own scene and the rays are moved instead (rebuilding 50,000 triangles costs 160 ms).
"""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int

from scapo.geometry.camera import Intrinsics
from scapo.geometry.matrices import moved
from sim_assets.models.textures import Paint
from sim_assets.objects import ArticulatedObject
from sim_assets.rendering.base import BACKGROUND, AbstractRenderer, Frame, RenderError, pixel_rays

REBUILD_BELOW = 12_000
"""Triangles up to which an object is merged and rebuilt for each view."""


class RaycastRenderer(AbstractRenderer):
    """Renders with Embree; see `AbstractRenderer`."""

    def __init__(self, *, color: bool = False, rebuild_below: int = REBUILD_BELOW) -> None:
        """Store colours or not; objects of more triangles than `rebuild_below` are never rebuilt.

        For several pictures of one object in a row, 0 is fastest.
        """
        self.color, self.rebuild_below = color, rebuild_below
        self.object: ArticulatedObject | None = None

    def open(self, thing: ArticulatedObject) -> None:
        """Take the triangles of each part; large objects get their scenes here."""
        self.object = thing
        meshes = [thing.part_mesh(part) for part in range(len(thing.visuals))]
        self.vertices = [np.asarray(mesh.vertices, np.float64) for mesh in meshes]
        self.faces = [np.asarray(mesh.faces, np.int32) for mesh in meshes]
        self.paints = [Paint(visuals) for visuals in thing.visuals] if self.color else []
        self.large = sum(len(faces) for faces in self.faces) > self.rebuild_below
        self.scenes = [
            _embree(vertices, faces) if self.large else None
            for vertices, faces in zip(self.vertices, self.faces, strict=True)
        ]

    def render(
        self,
        state: Float[np.ndarray, " J"],
        camera_T_object: Float[np.ndarray, "4 4"],
        camera: Intrinsics,
        only: int | None = None,
    ) -> Frame:
        """See `AbstractRenderer.render`."""
        if self.object is None:
            raise RenderError("expected an open object, found none")
        poses = camera_T_object @ self.object.pose(state)
        parts = range(len(poses)) if only is None else (only,)
        in_camera = {p: moved(self.vertices[p], poses[p]) for p in parts}
        pixels, rays = _rays(camera, np.concatenate(list(in_camera.values())))
        cast = self._cast_parts if self.large else self._cast_merged
        depth, part, face = cast(poses, in_camera, rays)
        shape = (camera.height, camera.width)
        image = np.zeros(shape, np.float32)
        label = np.full(shape, BACKGROUND, np.uint8)
        image.flat[pixels] = np.where(part == BACKGROUND, 0, depth)
        label.flat[pixels] = part
        if not self.color:
            return Frame(depth=image, part=label)
        color = np.zeros((*shape, 3), np.uint8)
        for p, paint in enumerate(self.paints):
            seen = np.flatnonzero(part == p)
            part_T_camera = np.linalg.inv(poses[p])
            surface = moved(rays[seen] * depth[seen, None], part_T_camera)
            inward = surface - part_T_camera[:3, 3]
            color.reshape(-1, 3)[pixels[seen]] = paint.colors(face[seen], surface, inward)
        return Frame(depth=image, part=label, color=color)

    def close(self) -> None:
        """Drop the object and its scenes."""
        self.object, self.scenes = None, []

    def _cast_merged(
        self,
        poses: Float[np.ndarray, "P 4 4"],
        in_camera: dict[int, Float[np.ndarray, "_ 3"]],
        rays: Float[np.ndarray, "K 3"],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        del poses
        parts = list(in_camera)
        counts = [len(in_camera[p]) for p in parts]
        starts = np.cumsum([0, *counts[:-1]])
        faces = np.concatenate([self.faces[p] + s for p, s in zip(parts, starts, strict=True)])
        vertices = np.concatenate([in_camera[p] for p in parts])
        directions = rays.astype(np.float32)
        hit = _embree(vertices, faces).run(np.zeros_like(directions), directions)
        depth = _plane_depth(vertices, faces, hit, np.zeros(3), rays)
        sizes = [len(self.faces[p]) for p in parts]
        part = np.repeat(np.array(parts, np.uint8), sizes)[hit]
        first = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes)[hit]
        return depth, np.where(hit < 0, BACKGROUND, part), hit - first

    def _cast_parts(
        self,
        poses: Float[np.ndarray, "P 4 4"],
        in_camera: dict[int, Float[np.ndarray, "_ 3"]],
        rays: Float[np.ndarray, "K 3"],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        depth = np.full(len(rays), np.inf)
        part = np.full(len(rays), BACKGROUND, np.uint8)
        face = np.full(len(rays), -1)
        for p in in_camera:
            part_T_camera = np.linalg.inv(poses[p])
            local = (rays @ part_T_camera[:3, :3].T).astype(np.float32)
            eye = part_T_camera[:3, 3]
            scene = self.scenes[p]
            if scene is None:
                raise RenderError(f"expected a scene of part {p}, found none")
            hit = scene.run(np.broadcast_to(eye.astype(np.float32), local.shape).copy(), local)
            exact = rays @ part_T_camera[:3, :3].T
            distance = _plane_depth(self.vertices[p], self.faces[p], hit, eye, exact)
            nearer = (hit >= 0) & (distance < depth)
            depth[nearer], part[nearer], face[nearer] = distance[nearer], p, hit[nearer]
        return depth, part, face


def _embree(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> EmbreeScene:
    scene = EmbreeScene(robust=True)  # no ray slips between two neighbouring triangles
    TriangleMesh(scene, vertices.astype(np.float32), faces)
    return scene


def _plane_depth(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    hit: Int[np.ndarray, " K"],
    eye: Float[np.ndarray, " 3"],
    rays: Float[np.ndarray, "K 3"],
) -> Float[np.ndarray, " K"]:
    """S with eye + s * ray in the plane of the triangle hit; rays have z = 1, so s is depth."""
    depth = np.full(len(hit), np.inf)
    seen = hit >= 0
    a, b, c = (vertices[faces[hit[seen], k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    depth[seen] = ((a - eye) * normal).sum(-1) / (rays[seen] * normal).sum(-1)
    return depth


def _rays(
    camera: Intrinsics, points: Float[np.ndarray, "V 3"]
) -> tuple[Int[np.ndarray, " K"], Float[np.ndarray, "K 3"]]:
    """Flat pixel indices and rays of the image rectangle that the points span."""
    height, width = camera.height, camera.width
    rays = pixel_rays(camera).reshape(height, width, 3)
    left, right, top, bottom = 0, width, 0, height
    if (points[:, 2] > 1e-6).all():
        u = points[:, 0] / points[:, 2] * camera.fx + camera.cx
        v = points[:, 1] / points[:, 2] * camera.fy + camera.cy
        left, right = np.clip([np.floor(u.min()) - 1, np.ceil(u.max()) + 1], 0, width).astype(int)
        top, bottom = np.clip([np.floor(v.min()) - 1, np.ceil(v.max()) + 1], 0, height).astype(int)
    index = np.arange(height * width).reshape(height, width)[top:bottom, left:right]
    return index.ravel(), rays[top:bottom, left:right].reshape(-1, 3)
