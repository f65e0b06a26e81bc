# SPDX-License-Identifier: MIT
"""Where objects come from: an asset is a small picklable description that a worker can load."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from sim_assets import procedural
from sim_assets.articulated import ArticulatedObject
from sim_assets.library import source_root
from sim_assets.reader import find, instance_id, read, select


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
    category: str
    up: str | None = None
    """Which axis of the URDF's root link is up; None: as the source says."""
    front: str | None = None
    """Which axis the front faces; None: as the source says, or told from the joint."""
    scale: float | None = None
    """Metres per unit of the URDF; None: as the source says."""

    @property
    def name(self) -> str:
        """The instance id."""
        return instance_id(self.urdf, self.root)

    def load(self) -> ArticulatedObject:
        """Read it.

        Raises:
            AssetError: It cannot be used, and why.
        """
        return read(
            self.urdf,
            self.category,
            up=self.up,
            front=self.front,
            scale=self.scale,
            root=self.root,
        )


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


def folder_assets(
    source: Path,
    category: str,
    split: str,
    *,
    up: str | None = None,
    front: str | None = None,
    scale: float | None = None,
) -> list[Asset]:
    """The models of a folder that belong to a split.

    Raises:
        AssetError: No such folder, or no model of this split in it.
    """
    root = source_root(source)
    return [
        UrdfAsset(urdf=urdf, root=root, category=category, up=up, front=front, scale=scale)
        for urdf in select(find(source), split, root)
    ]
