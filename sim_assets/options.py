# SPDX-License-Identifier: MIT
"""The options of `scapo-data generate` and `sim_assets.generate_samples`; imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scapo.ranges import Positive, Seed

SplitName = Literal["train", "val", "test", "test-ood"]
Protocol = Literal["joint", "isolated", "full"]
Sampling = Literal["random", "fps"]
Noise = Literal["none", "kinect", "disparity"]
Mask = Literal["exact", "imperfect"]
PresetName = Literal["sim-art", "sim-art-sensor", "sim-art-complete", "op-align", "eap"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DataOptions:
    """What data to make. The field docstrings are the help texts."""

    source: str = "procedural"
    """Source of the objects: `procedural`, or a folder of URDF models, searched recursively."""
    up: str | None = None
    """Axis of the URDF's root link that is up, such as z or -y; default: as the source has it."""
    front: str | None = None
    """Axis that a model's front (door, drawer, user side) faces; default: as the source has it."""
    scale: Positive | None = None
    """Scale: metres per unit of the URDF; default: as the source has it."""
    any_model: bool = False
    """Any model: take also one none of whose links, joints or semantics speaks of the category."""
    split: SplitName = "train"
    """Split to make; splits share no instance. Models are divided by a hash of their name,
    70:10:20, where the folder has no splits of its own; fewer than ten go whole into the split
    asked for."""
    count: int = 1000
    """Number of samples."""
    instances: int | None = None
    """Number of objects that they show; default: one for each 50 samples, or all models of the
    folder. Each shows count / instances samples, rounded up, unless the last would go without."""
    seed: Seed = 1
    """Seed of objects, joint states, cameras and points."""
    points: int = 1024
    """Points of a cloud; drawn with replacement where fewer pixels are visible."""
    protocol: Protocol | None = None
    """Protocol. joint: the depth image of the whole object. isolated: each part rendered alone, and
    merged (EAP, OP-Align). full: the whole surface. Default: the preset's, joint for sim-art."""
    preset: PresetName = "sim-art"
    """Preset of joint states, views and camera. sim-art: each category's travel and window, the
    object filling 50 to 90 % of the image. sim-art-sensor: the same windows, 640 x 480, a drawn
    distance. sim-art-complete: the whole surface of what sim-art shows, in the same states and
    places, turned by any rotation. op-align, eap: the published windows (isolated parts,
    farthest-point sampling, 640 x 480)."""
    noise: Noise = "none"
    """Noise of the depth sensor. kinect: structured light (Nguyen et al. 2012). disparity:
    disturbed and rounded disparities (Handa et al. 2014). Both with flying pixels and holes."""
    mask: Mask = "exact"
    """Mask: which pixels are taken for the object. imperfect: an outline with errors, missing
    pieces, and foreign points (part 255)."""
    backend: Literal["auto", "sapien", "raycast", "maniskill"] = "auto"
    """Renderer; auto: SAPIEN where a Vulkan device is found, else ray casting. maniskill: many
    objects at once, for CUDA GPUs."""
    image_size: int | None = None
    """Width and height in pixels; default: the preset's, 256 for sim-art, whose field of view is 60
    degrees."""
    sampling: Sampling | None = None
    """Sampling of points among the visible pixels: random (uniform), or fps (farthest points,
    slow). Default: the preset's, random for sim-art."""
    color: bool = False
    """Store the colour of each point."""
    images: bool = False
    """Images: write each sample's depth image (16 bit, mm), mask, camera and, with color, RGB as
    files beside the shards, as `scapo-bench infer` reads them. The shards stay as they are. For
    protocol joint."""
    ambiguity: bool = False
    """Store which of the 24 turns of a cube look as the object does (docs/ambiguity.md): tensors of
    their own, the others stay as they are. For protocols joint and full."""
    states_per_view: int = 1
    """Consecutive samples that show the same object from the same camera in other states."""
