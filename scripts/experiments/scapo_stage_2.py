# SPDX-License-Identifier: MIT
"""SCAPO's second stage from one first stage: what an option of it is worth, without its luck.

Terms of the loss that Table 3 leaves out, and labels of the semi-supervised variant, matter in
stage 2 alone. So stage 1 and the start of stage 2 are trained once, and every variant goes on from
there: a third of the time, and no difference between variants comes from another first stage.

    scapo-bench train scapo --preset warm --epochs 30 0 ... --out BASE
    python scripts/experiments/scapo_stage_2.py BASE --preset warm --epochs 30 4 ... --out RUN
"""

from __future__ import annotations

import sys
from pathlib import Path

from torch import Generator

import bench.__main__
from scapo.method import Stage
from scapo.paper.method import ARTICULATE, Scapo
from scapo.store import checkpoint
from scapo.types import Labels, Observation


def main(base: Path, options: list[str]) -> None:
    """Train what is left of a run whose first stage is another's."""
    stages = Scapo.stages

    def second(self: Scapo) -> tuple[Stage, ...]:
        return tuple(stage for stage in stages(self) if stage.name == ARTICULATE)

    def start(
        self: Scapo, stage: str, observation: Observation, labels: Labels, generator: Generator
    ) -> None:
        del stage, observation, labels, generator
        checkpoint.load_arrays(self, checkpoint.read_checkpoint(base)[0], base)

    Scapo.stages, Scapo.start = second, start
    sys.argv = ["scapo-bench", "train", "scapo", *options]
    bench.__main__.main()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
