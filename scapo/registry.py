# SPDX-License-Identifier: MIT
"""Methods by name: one line each, here the library's own, and those of other packages.

A package adds a method by one line of its metadata, an entry point of the group `scapo.methods`
that names a `Method`; training, predicting, scoring and `scapo.load` then know it by the name of
that entry. Nothing heavy is imported before a method is asked for.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    import torch

    from scapo.categories import Category
    from scapo.method import AbstractMethod
    from scapo.store.files import Header

GROUP = "scapo.methods"
"""Entry points of other packages; each names a `Method`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """One line of a table of methods."""

    title: str
    """What tables call it."""
    rank: int
    """Where its row stands in tables: the smallest first; the library's own from 70 on."""
    maker: str | Callable[..., Any]
    """The class, or `module:name` of it, which is then imported when it is asked for: called with
    configuration, category and the generator of the first weights."""
    presets: Mapping[str, str | Callable[[], Any]]
    """Configurations by name, each what makes it or `module:name` of that; the first is the
    default of the command line."""
    supervision: tuple[str, ...] = ()
    """Labels that it uses unless told otherwise: pose, segmentation, joint, instance."""
    camera: bool = False
    """Whether it uses the camera's position."""

    @property
    def kind(self) -> type[Any]:
        """The configuration's class."""
        return cast("type[Any]", type(self.preset(None)))

    def preset(self, name: str | None) -> Any:  # noqa: ANN401 - of the method's own type
        """The configuration of that name, or the default."""
        return _imported(self.presets.get(name or "", next(iter(self.presets.values()))))()

    def build(
        self,
        config: Any,  # noqa: ANN401
        category: Category,
        generator: torch.Generator,
    ) -> AbstractMethod:
        """The method with its first weights."""
        return _imported(self.maker)(config, category, generator)


def _imported(name: str | Callable[..., Any]) -> Callable[..., Any]:
    return cast("Callable[..., Any]", resolve_name(name)) if isinstance(name, str) else name


LIBRARY: dict[str, Method] = {
    "scapo": Method(
        title="SCAPO",
        rank=70,
        maker="scapo.paper.method:Scapo",
        presets={
            "paper": "scapo.paper.config:ScapoConfig",
            "literal": "scapo.paper.config:literal_config",
            "cpu": "scapo.paper.config:cpu_config",
            "complete": "scapo.paper.config:complete_config",
            "warm": "scapo.paper.config:warm_config",
        },
    ),
    "registered": Method(
        title="Template registration",
        rank=80,
        maker="scapo.registered.method:TemplateRegistration",
        presets={
            "cpu": "scapo.registered.config:cpu_config",
            "quick": "scapo.registered.config:quick_config",
        },
        camera=True,
    ),
    "registered-labelled": Method(
        title="Template registration, true template",
        rank=81,
        maker="scapo.registered.labelled:LabelledRegistered",
        presets={"cpu": "scapo.registered.labelled:LabelledConfig"},
        supervision=("segmentation", "pose", "joint", "instance"),
        camera=True,
    ),
}
"""The library's own."""


def known(own: Mapping[str, Method] = LIBRARY) -> dict[str, Method]:
    """These methods and, after them, those of other packages under names that are still free."""
    return {**own, **{name: found for name, found in external().items() if name not in own}}


@cache
def external() -> dict[str, Method]:
    """Methods of other packages; one that cannot be had costs a line of the log and no more."""
    found = {entry.name: _load(entry) for entry in entry_points(group=GROUP)}
    return {name: method for name, method in found.items() if method is not None}


def _load(entry: EntryPoint) -> Method | None:
    """The method of an entry point, None where there is none."""
    try:
        found: object = entry.load()
    except Exception as error:  # noqa: BLE001 - whatever other people's modules do when imported
        found = f"{type(error).__name__}: {error}"
    if isinstance(found, Method):
        return found
    words = " ".join(str(found).split())[:200]
    logging.getLogger(__name__).warning(
        "entry point %s = %s of %s: expected a scapo.registry.Method, found %s",
        entry.name, entry.value, GROUP, words,
    )  # fmt: skip
    return None


def load_method(
    path: Path, methods: Mapping[str, Method] | None = None
) -> tuple[AbstractMethod, Header]:
    """The trained method of a run folder or checkpoint file, in eval mode on the CPU.

    Args:
        path: Of the folder or the file.
        methods: Those that may be in it; None for the library's own and other packages'.

    Raises:
        StoreError: No checkpoint there, of none of the methods, or with values that cannot be.
    """
    import torch

    from scapo.store.checkpoint import (
        check_header,
        config_from,
        header_category,
        load_arrays,
        read_checkpoint,
    )
    from scapo.store.schema import StoreError
    from scapo.text import did_you_mean

    methods = known() if methods is None else methods
    arrays, header = read_checkpoint(path)
    name = header["method"]
    if name not in methods:
        close = did_you_mean(name, methods)
        raise StoreError(
            f"{path}: expected a method of {', '.join(methods)}, found {name!r}{close}"
        )
    entry = methods[name]
    config = config_from(entry.kind, header["config"], f"{path}: config")
    kind = header_category(check_header(header, str(path)), str(path))
    try:
        method = entry.build(config, kind, torch.Generator())
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
        words = " ".join(str(error).split())
        raise StoreError(f"{path}: config: expected one that builds, found {words}") from error
    load_arrays(method, arrays, path)
    return method.eval(), header
