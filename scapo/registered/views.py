# SPDX-License-Identifier: MIT
"""What a partial view says of an object: oriented surface points, and where nothing can be.

A cloud seen by a camera carries more than its points: normals face the camera, the rays in front
of every point are empty, and what lies behind is unknown. `PartialViews` keeps a batch of clouds in
this form: normalised (mean radius 0.25 about the origin), spread out by farthest-point sampling,
with normals and a coarse depth image that answers "free, observed or hidden" for any point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.geometry.points import farthest_points, gather, k_nearest_by_tree
from scapo.geometry.rigid import rotation_between

FAR = 1e3  # Depth of a cell that shows background, in normalised lengths: beyond all that is tried
CELLS = 24  # Of the depth image along either side: about 0.05 of normalised length each
MARGIN = 1.001  # Of the depth image about the points, so that rounding leaves none outside
TINY = 1e-6  # Least divisor, of sides of images and sums of weights that may be 0
LEAST_DEPTH = 1e-3
"""Normalised length that depths are divided by at least: no image of points behind the camera."""
NEIGHBOURS = 16  # Points that tell a normal: fewer follow the noise, more round off the edges


@dataclass(frozen=True, slots=True, kw_only=True)
class PartialViews:
    """A batch of clouds, each in its own normalised frame."""

    points: Float[Tensor, "B K 3"]
    """In the order of farthest-point sampling: the first n are spread out for any n."""
    normals: Float[Tensor, "B K 3"]
    """Unit, towards the camera."""
    camera: Float[Tensor, "B 3"]
    """The camera's centre."""
    look: Float[Tensor, "B 3 3"]
    """Rows: image x, image y and the direction from the camera to the origin."""
    depth: Float[Tensor, "B G G"]
    """Least depth seen in a cell or the eight around it; FAR where all show background."""
    centre: Float[Tensor, "B 2"]
    """Of the image's square, in units of x / z."""
    half: Float[Tensor, " B"]
    """Half the side of the square."""

    def direction(self) -> Float[Tensor, "B 3"]:
        """Unit vector from the origin to the camera."""
        return F.normalize(self.camera, dim=-1)

    def thinned(self, index: Int[Tensor, " K"]) -> PartialViews:
        """With these points only, of every view the same ones."""
        return replace(self, points=self.points[:, index], normals=self.normals[:, index])

    def scaled(self, factor: Float[Tensor, " B"]) -> PartialViews:
        """Each cloud so many times as large."""
        return replace(
            self,
            points=self.points * factor[:, None, None],
            camera=self.camera * factor[:, None],
            depth=self.depth * factor[:, None, None],
        )

    @torch.no_grad()
    def free_and_hidden(
        self, points: Float[Tensor, "B M 3"], tolerance: float
    ) -> tuple[Bool[Tensor, "B M"], Bool[Tensor, "B M"]]:
        """Whether each point would be seen in empty space, and whether something hides it.

        Neither: it lies within `tolerance` of what the camera saw there. Points on the background
        are free: the object would have been seen.

        Args:
            points: In the frame of each view.
            tolerance: Normalised length along the ray.
        """
        seen = (points - self.camera[:, None]) @ self.look.mT
        z = seen[..., 2]
        cells = self.depth.shape[-1] - 2
        image = seen[..., :2] / z.clamp_min(LEAST_DEPTH)[..., None]
        cell = (image - self.centre[:, None]) / self.half[:, None, None] * 0.5 + 0.5
        cell = (cell * cells + 1).floor().long().clamp(0, cells + 1)
        depth = self.depth.flatten(1).gather(1, cell[..., 1] * (cells + 2) + cell[..., 0])
        return z < depth - tolerance, z > depth + tolerance


@torch.no_grad()
def observe(
    points: Float[Tensor, "B N 3"],
    camera: Float[Tensor, "B 3"],
    *,
    count: int = 256,
    index: Int[Tensor, "B K"] | None = None,
    normals: Float[Tensor, "B N 3"] | None = None,
) -> PartialViews:
    """The views of normalised clouds.

    Args:
        points: Mean radius 0.25 about the origin.
        camera: The camera's centre in the same frame; estimated or known.
        count: Points kept, or all where there are fewer.
        index: Those points, where they are known (`farthest_points`).
        normals: Of all points, where they are known (`surface_normals`).
    """
    if index is None:
        index = farthest_points(points, min(count, points.shape[1]))
    kept = gather(points, index)
    own = surface_normals(kept, points, camera) if normals is None else gather(normals, index)
    look = look_along(camera)
    depth, centre, half = _depth_image(points, camera, look)
    return PartialViews(
        points=kept,
        normals=own,
        camera=camera,
        look=look,
        depth=depth,
        centre=centre,
        half=half,
    )


def surface_normals(
    points: Float[Tensor, "B K 3"], cloud: Float[Tensor, "B N 3"], camera: Float[Tensor, "B 3"]
) -> Float[Tensor, "B K 3"]:
    """Direction of least spread of the nearest points of `cloud`, turned towards the camera."""
    near = zip(points, cloud, strict=True)
    around = torch.stack([c[k_nearest_by_tree(p, c, NEIGHBOURS)] for p, c in near])
    around = around - around.mean(-2, keepdim=True)
    _, vectors = torch.linalg.eigh(around.mT @ around)
    normal = vectors[..., 0]
    facing = ((camera[:, None] - points) * normal).sum(-1, keepdim=True)
    return torch.where(facing < 0, -normal, normal)


def look_along(camera: Float[Tensor, "B 3"]) -> Float[Tensor, "B 3 3"]:
    """The smallest rotation that takes the direction from the camera to the origin to z."""
    forward = F.normalize(-camera, dim=-1)
    return rotation_between(forward, torch.eye(3).to(camera)[2].expand_as(forward))


def _depth_image(
    points: Float[Tensor, "B N 3"], camera: Float[Tensor, "B 3"], look: Float[Tensor, "B 3 3"]
) -> tuple[Float[Tensor, "B G G"], Float[Tensor, "B 2"], Float[Tensor, " B"]]:
    seen = (points - camera[:, None]) @ look.mT
    image = seen[..., :2] / seen[..., 2:].clamp_min(LEAST_DEPTH)
    low, high = image.amin(1), image.amax(1)
    centre, half = (low + high) / 2, (high - low).amax(-1).clamp_min(TINY) / 2 * MARGIN
    cell = ((image - centre[:, None]) / half[:, None, None] * 0.5 + 0.5) * CELLS
    cell = cell.long().clamp(0, CELLS - 1)
    depth = torch.full((len(points), CELLS * CELLS), FAR, dtype=points.dtype, device=points.device)
    depth = depth.scatter_reduce(1, cell[..., 1] * CELLS + cell[..., 0], seen[..., 2], "amin")
    depth = F.pad(depth.unflatten(1, (1, CELLS, CELLS)), (2, 2, 2, 2), value=FAR)
    return -F.max_pool2d(-depth, 3, 1)[:, 0], centre, half
