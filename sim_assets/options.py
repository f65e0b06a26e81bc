# SPDX-License-Identifier: MIT
"""The options of `scapo-data generate` and `sim_assets.generate_samples`; imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Protocol = Literal["joint", "isolated", "full"]
Sampling = Literal["random", "fps"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DataOptions:
    """What data to make. The field docstrings are the help texts."""

    source: str = "procedural"
    """`procedural`, or a folder of URDF models (searched recursively)."""
    up: str | None = None
    """Models: which axis of the URDF's root link is up, such as z or -y; default: the source's."""
    front: str | None = None
    """Models: which axis the front (door, drawer, user side) faces; default: the source's."""
    scale: float | None = None
    """Models: metres per unit of the URDF; default: the source's."""
    split: Literal["train", "val", "test", "test-ood"] = "train"
    """Splits share no instance. Models are divided by a hash of their name, 70:10:20, where the
    folder has no splits of its own; fewer than ten go whole into the split asked for."""
    count: int = 1000
    """Samples."""
    instances: int | None = None
    """Objects that they show; default: one for each 50 samples, or all models of the folder."""
    seed: int = 1
    """Of objects, joint states, cameras and points."""
    points: int = 1024
    """Points of a cloud; drawn with replacement where fewer pixels are visible."""
    protocol: Protocol = "joint"
    """joint: the depth image of the whole object. isolated: each part rendered alone, and merged
    (EAP, OP-Align). full: the whole surface."""
    noise: Literal["none"] = "none"
    """Of the depth sensor."""
    backend: Literal["auto", "sapien", "raycast"] = "auto"
    """Renderer; auto: SAPIEN where a Vulkan device is found, else ray casting."""
    image_size: int = 256
    """Width and height in pixels; the field of view is 60 degrees."""
    sampling: Sampling = "random"
    """Of points among the visible pixels: uniform, or farthest-point sampling (slow)."""
    color: bool = False
    """Store the colour of each point."""
    states_per_view: int = 1
    """Consecutive samples that show the same object from the same camera in other states."""
