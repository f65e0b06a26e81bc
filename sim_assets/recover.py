# SPDX-License-Identifier: MIT
"""The object that an instance of a data set shows: made again, or read again from its source."""

from __future__ import annotations

from pathlib import Path

from scapo.manifest import Instance, Manifest
from sim_assets.articulated import ArticulatedObject
from sim_assets.assets import Asset, ProceduralAsset, UrdfAsset
from sim_assets.library import source_root


class RecoverError(ValueError):
    """An object cannot be had again: `instance: expected, found`."""


def recover(manifest: Manifest, index: int, source: Path | None = None) -> ArticulatedObject:
    """The object of an instance, the same as when the data set was made.

    Args:
        manifest: Of the split.
        index: Into its instances.
        source: Folder of the models, for a data set that was made from some.

    Raises:
        RecoverError: It is of a set of clouds, its source is not at hand, or has changed.
    """
    instance = manifest.instances[index]
    asset = _asset(manifest, instance, source)
    try:
        thing = asset.load()
    except (ValueError, OSError) as error:
        raise RecoverError(f"{instance.id}: {error}") from error
    if thing.origin.sha256 != instance.sha256:
        raise RecoverError(
            f"{instance.id}: expected the object that the data set shows (sha256 "
            f"{instance.sha256[:12]}), found another ({thing.origin.sha256[:12]}): its source or "
            "its generator has changed since"
        )
    return thing


def _asset(manifest: Manifest, instance: Instance, source: Path | None) -> Asset:
    options = manifest.options
    kind = options.get("source")
    if kind == "procedural":
        number = instance.id.rpartition("-")[2]
        if number.isdigit():
            return ProceduralAsset(
                category=manifest.category,
                split=manifest.split,
                seed=manifest.seed,
                index=int(number),
            )
    if kind == "urdf":
        if source is None:
            raise RecoverError(
                f"{instance.id}: expected the folder of models (--source), found none"
            )
        root = source_root(source)
        urdf = root / instance.source
        if not urdf.is_file():
            raise RecoverError(f"{instance.id}: expected the model {urdf}, found none")
        return UrdfAsset(
            urdf=urdf,
            root=root,
            category=manifest.category,
            up=options.get("up"),
            front=options.get("front"),
            scale=options.get("scale"),
        )
    raise RecoverError(f"{instance.id}: expected procedural objects or URDF models, found {kind}")
