# SPDX-License-Identifier: MIT
"""What a data set holds, as text: counts, histograms of states and views, digests, damage."""

from __future__ import annotations

import math
import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scapo.store import Split, StoreError
from scapo.store.files import require, tensor_names
from scapo.store.manifest import Manifest, shards_digest
from scapo.store.schema import TENSORS
from scapo.text import one_line
from sim_assets.sampling.viewpoints import direction_angles

BARS = " ▁▂▃▄▅▆▇█"
BINS = 24
LONGEST_NAME = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Of one split."""

    text: str
    damage: str = ""
    """What is wrong with the first shard that is not what manifest and layout say."""


def find_splits(path: Path) -> list[Path]:
    """Folders with a manifest, at `path` or below it.

    Raises:
        StoreError: There is none.
    """
    found = sorted(
        Path(folder)
        for folder, below, names in os.walk(path)  # which names links to nothing too
        if "manifest.json" in (*names, *below)
    )
    if not found:
        raise StoreError(f"{path}: expected a data set (manifest.json), found none")
    return found


def describe_split(split: Split) -> Report:
    """The report of one split; its shards are compared with their hashes, and read whole."""
    manifest = split.manifest
    lines = [one_line(split.folder), *map(_line, _facts(manifest))]
    try:
        split.verify()
        for shard, arrays in zip(manifest.shards, split.shards(), strict=True):
            require(split.folder / shard.file, TENSORS, arrays)
        lines += map(_line, histograms(split))
        lines.append(f"  shards     {len(manifest.shards)}, all whole")
    except StoreError as error:
        text = "\n".join([*lines, _line(f"DAMAGED    {error}")])
        return Report(text=text, damage=str(error))
    return Report(text="\n".join(lines))


def _facts(manifest: Manifest) -> list[str]:
    options = manifest.options
    told = ("protocol", "preset", "noise", "mask", "backend", "sampling", "source")
    how = ", ".join(f"{name} {options[name]}" for name in told if options.get(name) is not None)
    lines = [
        f"category   {manifest.category} ({', '.join(manifest.parts)}), split {manifest.split}",
        f"samples    {manifest.count} of {manifest.points} points, "
        f"{len(manifest.instances)} objects, seed {manifest.seed}",
        f"options    {how}",
        "versions   " + ", ".join(f"{k} {v}" for k, v in sorted(manifest.versions.items())),
        f"digest     {manifest.digest}{_whose(manifest)}",
        f"plan       {manifest.plan_digest}",
    ]
    traits = Counter(instance.trait for instance in manifest.instances if instance.trait)
    if traits:
        lines.append("  traits     " + ", ".join(f"{n} {name}" for name, n in traits.items()))
    facts = manifest.statistics
    if "redrawn_share" in facts:
        lines.append(f"redrawn    {100 * facts['redrawn_share']:.2f} % of the views drawn")
    if facts.get("samples_lost") or facts.get("objects_refused"):
        lines.append(
            f"left out   {facts.get('objects_refused', 0):.0f} objects refused, "
            f"{facts.get('objects_failed', 0):.0f} failed, "
            f"{facts.get('samples_lost', 0):.0f} samples lost"
        )
    return lines


def _whose(manifest: Manifest) -> str:
    """What is to be said of a digest that is not over the shards' hashes, as ours are."""
    own = manifest.digest == shards_digest(manifest.shards)
    return "" if own else ", which is not over these shards as this project's are"


def histograms(split: Split) -> list[str]:
    """One line each for joint states, views, and the parts' share of points."""
    manifest = split.manifest
    known = "part", "camera_T_part", "joint_state", "visible", "instance"
    data = split.arrays(*known, *(("sensor",) if _in_another_frame(split) else ()))
    lines = []
    for j, joint in enumerate(manifest.joints):
        turning = joint.kind == "revolute"
        state = data["joint_state"][:, j]
        values, unit = (np.degrees(state), "deg") if turning else (state, "m")
        lines.append(histogram(f"joint {j}", values, unit))
    pose = data["camera_T_part"][:, 0].astype(np.float64)
    away = data.get("sensor", 0.0) - pose[:, :3, 3]
    eye = (pose[:, :3, :3].transpose(0, 2, 1) @ away[..., None])[..., 0]
    angles = direction_angles(eye)
    lines.append(histogram("azimuth", angles[:, 0], "deg"))
    lines.append(histogram("elevation", angles[:, 1], "deg"))
    lines.append(histogram("distance", np.linalg.norm(eye, axis=-1), "m"))
    for p, name in enumerate(manifest.parts):
        share = 100 * (data["part"] == p).mean(-1)
        short = one_line(name, LONGEST_NAME)
        lines.append(histogram(f"points on {short}", share, "%"))
        lines.append(histogram(f"{short} visible", 100 * data["visible"][:, p], "%"))
    if "ambiguity" in manifest.options:
        lines.append(_ambiguous(split))
    per_object = np.bincount(data["instance"], minlength=len(manifest.instances))
    lines.append(f"per object {per_object.min()} to {per_object.max()} samples")
    return lines


def _in_another_frame(split: Split) -> bool:
    """Whether clouds are not in their cameras' frames, whose centres the split then has."""
    shards = split.manifest.shards
    return bool(shards) and "sensor" in tensor_names(split.folder / shards[0].file)


def _ambiguous(split: Split) -> str:
    alike = split.arrays("alike")["alike"] == 1
    several = alike[:, 1:].any(1)
    turns = np.flatnonzero(alike[:, 1:].any(0)) + 1
    which = f", turns {', '.join(map(str, turns))}" if len(turns) else ""
    return f"ambiguous  {100 * several.mean():.1f} % of the views look alike when turned{which}"


def _line(text: str) -> str:
    """Indented, and on one line whatever names the manifest has."""
    return f"  {one_line(text)}"


def describe_state(state: float, kind: str) -> str:
    """A joint's state with its unit, a dash where it is not known."""
    if not math.isfinite(state):
        return "–"
    return f"{math.degrees(state):.0f}°" if kind == "revolute" else f"{100 * state:.0f} cm"


def histogram(name: str, values: Float[np.ndarray, " K"], unit: str) -> str:
    """One line: name, least value, bars, greatest value and unit, mean; of the known values."""
    values = values[~np.isnan(values)]
    if not len(values):
        return f"{name:22} unknown"
    low, high = float(values.min()), float(values.max())
    counts, _ = np.histogram(values, bins=BINS, range=(low, high if high > low else low + 1))
    level = np.ceil(counts / counts.max() * (len(BARS) - 1)).astype(int)
    bars = "".join(BARS[i] for i in level)
    mean = f"mean {values.mean():.4g}"
    return f"{name:22} {low:9.4g} {bars} {high:.4g} {unit}, {mean}"
