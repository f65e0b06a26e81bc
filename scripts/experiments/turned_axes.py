#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""How far may an axis be off, and the joint still opens?

    python scripts/experiments/turned_axes.py DATA CATEGORY ... [--split val] [--limit 40]

Prints the table of docs/actuate.md: the truth as a prediction, its axes turned by an angle about
lines drawn at random at right angles to them, the pivots left where they are; percent of the joints
of the first samples that `scapo-data actuate` counts as moved far enough.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from scapo.store import Split, open_split
from scapo.store.predictions import Header, write_predictions
from sim_assets.actuation.actuate import actuate
from sim_assets.generation.generate import Running

DEGREES = (0, 10, 20, 30, 45, 90)


def turned(axis: np.ndarray, degrees: float) -> np.ndarray:
    """Axes turned by an angle, each about a line of its own."""
    across = np.cross(axis, np.random.default_rng(5).normal(size=axis.shape))
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.radians(degrees)
    return (np.cos(angle) * axis + np.sin(angle) * across).astype(np.float32)


def success(split: Split, root: Path, degrees: float, limit: int) -> float:
    """Percent of the joints that move."""
    manifest = split.manifest
    arrays = split.arrays("part", "joint_pivot", "joint_axis")
    arrays["joint_axis"] = turned(arrays["joint_axis"], degrees)
    header = Header(
        method="truth", variant=f"{degrees} degrees", category=manifest.category,
        split=manifest.split, seed=1, data_digest=manifest.digest, supervision=(),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "turned.safetensors"
        write_predictions(path, header, arrays)
        out = Path(folder) / "turned.csv"
        rows = actuate(path, root, out, limit=limit, running=Running(workers=0))
    return 100 * float(np.mean([bool(row.success) for row in rows]))


def main() -> None:
    """Print a row for each category."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("category", nargs="+")
    parser.add_argument("--split", default="val")
    parser.add_argument("--limit", type=int, default=40)
    given = parser.parse_args()
    print("| | " + " | ".join(f"{degrees}°" for degrees in DEGREES) + " |")
    for category in given.category:
        split = open_split(given.data, category, given.split)
        found = [success(split, given.data, degrees, given.limit) for degrees in DEGREES]
        print(f"| {category} | " + " | ".join(f"{value:g}" for value in found) + " |", flush=True)


if __name__ == "__main__":
    main()
