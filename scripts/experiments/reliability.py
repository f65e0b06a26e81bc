#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""Draw how far the confidences of the released models' joints may be trusted, and print it.

    python scripts/experiments/reliability.py results/checkpoints OUT.png [--mode refine]

Reads what `scapo-bench calibrate` wrote beside the checkpoints; asks no model.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.infer.calibration import Reliability, calibration_file, read_calibration
from bench.infer.diagram import reliability_picture
from scapo.store import sha256_file


def main() -> None:
    """Print the rows of the table, draw the joints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--mode", choices=("fast", "quick", "refine"), default="refine")
    given = parser.parse_args()
    joints: dict[str, Reliability] = {}
    for file in sorted(given.folder.glob("*.safetensors")):
        path = calibration_file(file, given.mode)
        if not path.is_file():
            continue
        found = read_calibration(path, sha256_file(file))
        name = file.stem.replace("-", "/", 1)
        joints[name] = found.reliability["joint"]
        cells = [name, str(found.samples)]
        for kind in ("joint", "part"):
            one = found.reliability[kind]
            cells += [f"{one.base_rate:.0%}", f"{one.error:.0%}", f"{one.brier:.3f}"]
        print(f"| {' | '.join(cells)} |")
    reliability_picture(joints, given.out, f"axis within 5 degrees, {given.mode}")


if __name__ == "__main__":
    main()
