# SPDX-License-Identifier: MIT
"""What a renderer is: an object and a camera in, depth and part indices out.

Three backends answer to it: `scene` (SAPIEN), `raycast` (Embree) and `parallel_scene` (ManiSkill,
many objects at once). All send one ray through the centre of each pixel and see both sides of every
surface, so their pictures agree (tests compare them).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8

from scapo.camera import Intrinsics
from sim_assets.articulated import ArticulatedObject

Backend = Literal["sapien", "raycast", "maniskill"]
AUTO: tuple[Backend, ...] = ("sapien", "raycast")
"""What `auto` tries, in this order; many objects at once pay on a GPU only, and are asked for."""
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
class Ask:
    """A picture asked for: the arguments of `AbstractRenderer.render`."""

    state: Float[np.ndarray, " J"]
    camera_T_object: Float[np.ndarray, "4 4"]
    camera: Intrinsics
    only: int | None = None


class AbstractParallelRenderer(AbstractRenderer):
    """Shows several objects at once, each in a place of its own."""

    places: int
    """How many it shows at once with profit."""

    @abstractmethod
    def open_all(self, things: Sequence[ArticulatedObject]) -> None:
        """Show one object in each place from now on; the same one may be in several."""

    @abstractmethod
    def render_all(self, asks: Sequence[Ask | None]) -> list[Frame | None]:
        """A picture for each place that asks for one; all with the same intrinsics.

        Raises:
            RenderError: The device failed.
        """


def resolve_backend(name: str) -> Backend:
    """The backend that `auto` or a backend's name means on this machine.

    Raises:
        RenderError: That backend does not work here, and why.
    """
    known: tuple[Backend, ...] = get_args(Backend)
    if name != "auto" and name not in known:
        raise RenderError(f"backend: expected auto or one of {', '.join(known)}, found {name!r}")
    why = {}
    for backend in AUTO if name == "auto" else known:
        if name in ("auto", backend):
            why[backend] = _CHECK[backend]()
            if why[backend] is None:
                return backend
    reasons = "; ".join(f"{backend}: {reason}" for backend, reason in why.items())
    raise RenderError(
        f"expected a renderer that works here, found none ({reasons}); "
        "`scapo-data doctor` says what to install"
    )


def make_renderer(backend: Backend, *, color: bool = False) -> AbstractRenderer:
    """A renderer of this backend; `color` asks for `Frame.color` too.

    Raises:
        RenderError: It does not work here.
    """
    if backend == "sapien":
        from sim_assets.scene import SapienRenderer

        return SapienRenderer(color=color)
    if backend == "maniskill":
        from sim_assets.parallel_scene import ManiSkillRenderer

        return ManiSkillRenderer(color=color)
    from sim_assets.raycast import RaycastRenderer

    return RaycastRenderer(color=color)


def _sapien_missing() -> str | None:
    if find_spec("sapien") is None:
        return "the package sapien is not installed"
    from sim_assets.scene import find_device

    try:
        find_device()
    except RenderError as error:
        return str(error)
    return None


def _raycast_missing() -> str | None:
    return None if find_spec("embreex") else "the package embreex is not installed"


def _maniskill_missing() -> str | None:
    if find_spec("mani_skill") is None:
        return "the package mani_skill is not installed (pip install 'scapo[gpu-sim]')"
    return _sapien_missing()


_CHECK: dict[str, Callable[[], str | None]] = {
    "sapien": _sapien_missing,
    "raycast": _raycast_missing,
    "maniskill": _maniskill_missing,
}
