# SPDX-License-Identifier: MIT
"""Where objects come from: an asset is a small picklable description that a worker can load.

The object that an instance of a data set shows: made again, or read again from its source.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from scapo.categories import Category
from scapo.store.definitions import category_of
from scapo.store.manifest import Instance, Manifest
from sim_assets import procedural
from sim_assets.models.account import check_speaks
from sim_assets.models.library import source_root
from sim_assets.models.reader import find, instance_id, read, select
from sim_assets.models.validate import AssetError
from sim_assets.objects import ArticulatedObject
from sim_assets.options import DataOptions


@runtime_checkable
class Asset(Protocol):
    """What can be loaded; picklable."""

    @property
    def name(self) -> str:
        """The instance id of the object that `load` gives."""
        ...

    def load(self) -> ArticulatedObject:
        """Make or read the object.

        Raises:
            ValueError: It cannot be used, and why.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ProceduralAsset:
    """An instance that a generator makes."""

    category: str
    split: str
    seed: int
    index: int

    @property
    def name(self) -> str:
        """The instance id."""
        return f"{self.category}-{self.split}-{self.seed}-{self.index:05d}"

    def load(self) -> ArticulatedObject:
        """Make it."""
        return procedural.generate(self.category, self.split, self.seed, self.index)


@dataclass(frozen=True, slots=True, kw_only=True)
class UrdfAsset:
    """A model in a folder of models."""

    urdf: Path
    root: Path
    """The source folder."""
    category: str | Category
    up: str | None = None
    """Which axis of the URDF's root link is up; None: as the source says."""
    front: str | None = None
    """Which axis the front faces; None: as the source says, or told from the joint."""
    scale: float | None = None
    """Metres per unit of the URDF; None: as the source says."""
    any_model: bool = False
    """Whether a model that does not speak of the category is taken too."""

    @property
    def name(self) -> str:
        """The instance id."""
        return instance_id(self.urdf, self.root)

    def load(self) -> ArticulatedObject:
        """Read it.

        Raises:
            AssetError: It cannot be used, and why; names files as seen from the source folder.
        """
        try:
            thing = read(
                self.urdf,
                self.category,
                up=self.up,
                front=self.front,
                scale=self.scale,
                root=self.root,
            )
            if not self.any_model:
                check_speaks(self.urdf, thing)
        except AssetError as error:  # its words may stand in a manifest: equal on every machine
            raise error.below(self.root) from error
        return thing


def procedural_assets(category: str, split: str, seed: int, count: int) -> list[Asset]:
    """The first `count` instances that a generator makes.

    Raises:
        ValueError: There is no generator of this category.
    """
    procedural.recipe(category)
    return [
        ProceduralAsset(category=category, split=split, seed=seed, index=index)
        for index in range(count)
    ]


def folder_assets(category: str | Category, options: DataOptions) -> list[Asset]:
    """The models of the folder `options.source` that belong to the split, read as options say.

    Raises:
        AssetError: No such folder, or no model of this split in it.
    """
    source = Path(options.source)
    root = source_root(source)
    return [
        UrdfAsset(
            urdf=urdf,
            root=root,
            category=category,
            up=options.up,
            front=options.front,
            scale=options.scale,
            any_model=options.any_model,
        )
        for urdf in select(find(source), options.split, root)
    ]


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
            category=category_of(manifest),
            up=options.get("up"),
            front=options.get("front"),
            scale=options.get("scale"),
            any_model=True,  # it was taken then
        )
    raise RecoverError(f"{instance.id}: expected procedural objects or URDF models, found {kind}")
