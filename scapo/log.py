# SPDX-License-Identifier: MIT
"""The record of a run: metrics.jsonl, and TensorBoard where it is installed."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scapo.files import canonical_json, write_bytes


class Log:
    """Means over a few steps, one JSON line each; the same run writes the same bytes."""

    def __init__(self, folder: Path, step: int) -> None:
        """Open the log of a run that has done `step` steps; later lines are dropped."""
        self.path = folder / "metrics.jsonl"
        lines = self.path.read_text().splitlines() if self.path.is_file() else []
        kept = [line for line in lines if _step_of(line) <= step]
        write_bytes(self.path, "".join(f"{line}\n" for line in kept).encode())
        self.file = self.path.open("a")
        self.board = _board(folder / "tensorboard", step)
        self.sums: dict[str, Tensor] = {}
        self.count = 0
        self.rate = 0.0
        self.latest: float | None = None

    def collect(self, values: dict[str, Tensor], rate: float) -> None:
        """Add one step's scalars and learning rate; nothing is copied from the device yet."""
        for name, value in values.items():
            held = value.detach()
            self.sums[name] = self.sums[name] + held if name in self.sums else held
        self.count += 1
        self.rate = rate

    def write(self, step: int, stage: str) -> None:
        """A line of the means since the last one."""
        if not self.count:
            return
        means = torch.stack([value.double() for value in self.sums.values()]) / self.count
        row = dict(zip(self.sums, means.tolist(), strict=True))
        self.latest = row["loss"]
        record = {"step": step, "stage": stage, "lr": self.rate, **row}
        self.file.write(canonical_json(record) + "\n")
        self.file.flush()
        for name, value in row.items():
            self.scalar(f"{stage}/{name}", value, step)
        self.sums, self.count = {}, 0

    def scalar(self, name: str, value: float, step: int) -> None:
        """A number for TensorBoard alone."""
        if self.board is not None:
            self.board.add_scalar(name, value, step)

    def close(self) -> None:
        """Flush both."""
        self.file.close()
        if self.board is not None:
            self.board.close()


def _step_of(line: str) -> float:
    """The step of a line; infinite for one that a kill cut off."""
    try:
        return json.loads(line)["step"]
    except ValueError:
        return float("inf")


def _board(folder: Path, step: int) -> Any:  # noqa: ANN401 - None, or a writer of an extra
    if importlib.util.find_spec("tensorboard") is None:
        return None
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=step or None)
