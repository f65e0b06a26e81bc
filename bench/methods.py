# SPDX-License-Identifier: MIT
"""The methods that can be trained: one explicit line each, nothing else to be told elsewhere.

The library's own stand in `scapo.registry`, baselines here; other packages add theirs by the entry
point group `scapo.methods`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from scapo.registry import LIBRARY, Method, known, load_method

if TYPE_CHECKING:
    from scapo.method import AbstractMethod
    from scapo.store.files import Header

METHODS: dict[str, Method] = {
    **LIBRARY,
    "icp": Method(title="ICP", rank=40, maker="bench.baselines.icp:Icp",
                  presets={"paper": "bench.baselines.icp:IcpConfig"},
                  supervision=("segmentation", "pose", "joint", "instance")),
    "kiss-matcher": Method(title="KISS-Matcher, then ICP", rank=41,
                           maker="bench.baselines.kiss_matcher:KissMatcher",
                           presets={"cpu": "bench.baselines.kiss_matcher:KissMatcherConfig"},
                           supervision=("segmentation", "pose", "joint", "instance")),
}  # fmt: skip


def all_methods() -> dict[str, Method]:
    """METHODS and those of other packages."""
    return known(METHODS)


def find(name: str) -> Method | None:
    """The method of this name; other packages are asked only where METHODS lacks it."""
    return METHODS.get(name) or known(METHODS).get(name)


def load(run: Path) -> tuple[AbstractMethod, Header]:
    """The trained method of a run folder or checkpoint file; see `scapo.registry.load_method`."""
    return load_method(run, all_methods())
