# SPDX-License-Identifier: MIT
"""The methods that can be trained: one explicit line each, nothing else to be told elsewhere.

The library's own stand in `scapo.registry`, baselines here; other packages add theirs by the entry
point group `scapo.methods`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from scapo.registry import LIBRARY, Method, known, load_method
from scapo.released import find as find_checkpoint

if TYPE_CHECKING:
    from scapo.method import AbstractMethod
    from scapo.store import Split
    from scapo.store.files import Header

METHODS: dict[str, Method] = {
    **LIBRARY,
    "gcn3d": Method(title="3DGCN", rank=10, maker="bench.baselines.gcn3d:Gcn3d",
                    presets={"paper": "bench.baselines.gcn3d:Gcn3dConfig",
                             "cpu": "bench.baselines.gcn3d:cpu_config"},
                    supervision=("pose", "segmentation", "joint")),
    "pointnet2": Method(title="PointNet++", rank=20, maker="bench.baselines.pointnet2:PointNet2",
                        presets={"paper": "bench.baselines.pointnet2:PointNet2Config",
                                 "cpu": "bench.baselines.pointnet2:cpu_config"},
                        supervision=("pose", "segmentation", "joint")),
    "icp": Method(title="ICP", rank=40, maker="bench.baselines.icp:Icp",
                  presets={"paper": "bench.baselines.icp:IcpConfig"},
                  supervision=("segmentation", "pose", "joint", "instance")),
    "kiss-matcher": Method(title="KISS-Matcher, then ICP", rank=41,
                           maker="bench.baselines.kiss_matcher:KissMatcher",
                           presets={"cpu": "bench.baselines.kiss_matcher:KissMatcherConfig"},
                           supervision=("segmentation", "pose", "joint", "instance")),
    "npcs-epn": Method(title="NPCS-EPN", rank=30, maker="bench.baselines.npcs_epn:NpcsEpn",
                       presets={"paper": "bench.baselines.npcs_epn:NpcsEpnConfig",
                                "cpu": "bench.baselines.npcs_epn:cpu_config"},
                       supervision=("segmentation", "pose", "joint")),
    "eap": Method(title="EAP", rank=50, maker="bench.baselines.eap.method:Eap",
                  presets={"paper": "bench.baselines.eap.method:EapConfig",
                           "cpu": "bench.baselines.eap.method:cpu_config"}),
    "op-align": Method(title="OP-Align", rank=60, maker="bench.baselines.op_align.method:OpAlign",
                       presets={"paper": "bench.baselines.op_align.method:OpAlignConfig",
                                "cpu": "bench.baselines.op_align.method:cpu_config"}),
}  # fmt: skip


def all_methods() -> dict[str, Method]:
    """METHODS and those of other packages."""
    return known(METHODS)


def find(name: str) -> Method | None:
    """The method of this name; other packages are asked only where METHODS lacks it."""
    return METHODS.get(name) or known(METHODS).get(name)


def load(run: Path) -> tuple[AbstractMethod, Header]:
    """The trained method of a run folder, checkpoint file or name of a released model.

    Raises:
        StoreError: As `scapo.released.find` and `scapo.registry.load_method`.
    """
    return load_method(find_checkpoint(run), all_methods())


def check_points(method: AbstractMethod, split: Split) -> None:
    """Refuse clouds that the method cannot answer, before any work.

    Raises:
        ValueError: They have fewer points than it needs.
    """
    found = split.manifest.points
    if found < method.least_points:
        raise ValueError(
            f"{split.folder}: expected clouds of {method.least_points} points or more, as "
            f"{method.name} needs with these flags, found {found}"
        )
