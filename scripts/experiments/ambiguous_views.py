#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""How many views of a benchmark nobody could tell apart from a turned object, by elevation.

Prints the table of docs/ambiguity.md from the stored tensor `alike`, no method and no prediction:
`python scripts/experiments/ambiguous_views.py DATA`, DATA as `scapo-data benchmark` wrote it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

BANDS = ((0, 15), (15, 30), (30, 45), (45, 60), (60, 90))
"""Degrees of the camera above the object's horizon."""


def elevation(camera_T_base: np.ndarray) -> np.ndarray:
    """Degrees of the camera above the horizon of the object, whose z points up."""
    rotation, translation = camera_T_base[:, :3, :3], camera_T_base[:, :3, 3]
    camera = -(rotation.swapaxes(1, 2) @ translation[..., None])[..., 0]
    return np.degrees(np.arcsin(camera[:, 2] / np.linalg.norm(camera, axis=1)))


def main(root: Path) -> None:
    """One row for each split that stores `alike`."""
    print("| split | ambiguous | turns | by elevation of the camera, deg (views) |")
    print("|---|---|---|---|")
    for folder in sorted(root.glob("*/*/test*")):
        shards = [load_file(path) for path in sorted(folder.glob("*.safetensors"))]
        alike = np.concatenate([shard["alike"] for shard in shards])[:, 1:] > 0
        above = elevation(np.concatenate([shard["camera_T_part"][:, 0] for shard in shards]))
        any_turn = np.asarray(alike.any(1))
        turns = " ".join(str(turn + 1) for turn in np.flatnonzero(alike.any(0)))
        bands = [
            f"{low} to {high}: {100 * any_turn[here].mean():.0f} % ({here.sum()})"
            for low, high in BANDS
            for here in [(above >= low) & (above < high)]
            if any_turn.any() and here.any()
        ]
        name = folder.relative_to(root)
        print(f"| {name} | {100 * any_turn.mean():.1f} % | {turns} | {', '.join(bands)} |")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
