# SPDX-License-Identifier: MIT
"""What a renderer is: an object and a camera in, depth and part indices out.

Three backends answer to it: `sapien`, `embree` and `maniskill` (many objects at once). All send one
ray through the centre of each pixel and see both sides of every surface, so their pictures agree
(tests compare them).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from scapo.geometry.camera import Intrinsics
from sim_assets.objects import ArticulatedObject

Backend = Literal["sapien", "raycast", "maniskill"]
BACKGROUND = 255
"""Part index of a pixel that shows no object."""


class RenderError(RuntimeError):
    """A renderer cannot do what was asked: `what was expected, what was found`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One picture."""

    depth: Float[np.ndarray, "H W"]
    """z in the camera frame at the pixel's centre, m; 0 where there is no object."""
    part: UInt8[np.ndarray, "H W"]
    """Part index; 255 where there is no object."""
    color: UInt8[np.ndarray, "H W 3"] | None = None
    """Unlit colour of the surface, sRGB."""


@lru_cache(maxsize=4)
def pixel_rays(camera: Intrinsics) -> Float[np.ndarray, "K 3"]:
    """Rays through the centres of all pixels, row by row, with z = 1; not to be written to."""
    u = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    x, y = np.meshgrid(u, v)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    rays.setflags(write=False)
    return rays


class AbstractRenderer(ABC):
    """Opens one object at a time; a context manager that lets go of it."""

    @abstractmethod
    def open(self, thing: ArticulatedObject) -> None:
        """Show this object from now on, and let go of the one before."""

    @abstractmethod
    def render(
        self,
        state: Float[np.ndarray, " J"],
        camera_T_object: Float[np.ndarray, "4 4"],
        camera: Intrinsics,
        only: int | None = None,
    ) -> Frame:
        """Picture of the object with its joints at `state` (rad or m).

        Args:
            state: Joint states, 0 at rest.
            camera_T_object: OpenCV camera frame.
            camera: Intrinsics.
            only: Show this part alone, as if the others were not there.

        Raises:
            RenderError: No object is open, or the device failed.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of the object; doing it twice is allowed."""

    def __enter__(self) -> AbstractRenderer:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderRequest:
    """A picture to render: the arguments of `AbstractRenderer.render`."""

    state: Float[np.ndarray, " J"]
    camera_T_object: Float[np.ndarray, "4 4"]
    camera: Intrinsics
    only: int | None = None


class AbstractParallelRenderer(AbstractRenderer):
    """Shows several objects at once, each in a sub-scene of its own."""

    capacity: int
    """How many it shows at once with profit."""

    @abstractmethod
    def open_all(self, things: Sequence[ArticulatedObject]) -> None:
        """Show one object in each sub-scene from now on; the same one may be in several."""

    @abstractmethod
    def render_all(self, requests: Sequence[RenderRequest | None]) -> list[Frame | None]:
        """A picture for each sub-scene that has a request; all with the same intrinsics.

        Raises:
            RenderError: The device failed.
        """
