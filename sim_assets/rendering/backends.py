# SPDX-License-Identifier: MIT
"""Which renderers work here, and one of them made; a backend is imported when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import get_args

from sim_assets.rendering.base import AbstractRenderer, Backend, RenderError

AUTO: tuple[Backend, ...] = ("sapien", "raycast")
"""What `auto` tries, in this order; many objects at once pay on a GPU only, and are asked for."""


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
        from sim_assets.rendering.sapien import SapienRenderer

        return SapienRenderer(color=color)
    if backend == "maniskill":
        from sim_assets.rendering.maniskill import ManiSkillRenderer

        return ManiSkillRenderer(color=color)
    from sim_assets.rendering.embree import RaycastRenderer

    return RaycastRenderer(color=color)


def _sapien_missing() -> str | None:
    if find_spec("sapien") is None:
        return "the package sapien is not installed"
    from sim_assets.rendering.sapien import find_device

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
