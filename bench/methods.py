# SPDX-License-Identifier: MIT
"""The methods that can be trained: one explicit line each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch

from bench.baselines.icp import Icp, IcpConfig
from scapo.categories import Category, category
from scapo.method import AbstractMethod
from scapo.paper.method import Scapo, ScapoConfig, cpu_config
from scapo.registered.method import RegisteredScapo
from scapo.registered.method import cpu_config as cpu_registered
from scapo.store.checkpoint import config_from, load_arrays, read_checkpoint
from scapo.store.files import Header
from scapo.store.schema import StoreError


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """How a method is made."""

    build: Callable[[Any, Category, torch.Generator], AbstractMethod]
    """From configuration, category and the generator of its first weights."""
    presets: Mapping[str, Any]
    """Configurations by name; the first is the default of the command line."""

    @property
    def kind(self) -> type[Any]:
        """The configuration's class."""
        return cast("type[Any]", type(self.preset(None)))

    def preset(self, name: str | None) -> Any:  # noqa: ANN401 - of the method's own type
        """The configuration of that name, or the default."""
        return self.presets.get(name or "", next(iter(self.presets.values())))


METHODS: dict[str, Method] = {
    "scapo": Method(build=Scapo, presets={"paper": ScapoConfig(), "cpu": cpu_config()}),
    "registered": Method(build=RegisteredScapo, presets={"cpu": cpu_registered()}),
    "icp": Method(build=Icp, presets={"paper": IcpConfig()}),
}


def load(run: Path) -> tuple[AbstractMethod, Header]:
    """The trained method of a run folder or checkpoint file, in eval mode on the CPU.

    Raises:
        StoreError: No checkpoint there, or not one of METHODS.
    """
    arrays, header = read_checkpoint(run)
    name = header.get("method")
    if name not in METHODS:
        raise StoreError(f"{run}: expected a method of {', '.join(METHODS)}, found {name!r}")
    config: Any = config_from(METHODS[name].kind, header["config"], f"{run}: config")
    method = METHODS[name].build(config, category(header["category"]), torch.Generator())
    load_arrays(method, arrays, run)
    return method.eval(), header
