# SPDX-License-Identifier: MIT
"""metrics.jsonl holds means, and a resumed log is that of an uninterrupted run."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from scapo.training.log import Log


def rows(folder: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_lines_are_means_since_the_last(tmp_path: Path) -> None:
    log = Log(tmp_path, 0)
    for value in (1.0, 3.0):
        log.collect({"loss": torch.tensor(value)}, 0.1)
    assert log.latest is None
    log.write(
        2,
        "s",
    )
    log.write(2, "s")  # nothing new: no line
    log.collect({"loss": torch.tensor(5.0)}, 0.2)
    log.write(3, "s")
    log.close()
    assert [(row["step"], row["loss"], row["lr"]) for row in rows(tmp_path)] == [
        (2, 2.0, 0.1),
        (3, 5.0, 0.2),
    ]
    assert log.latest == 5.0


def test_lines_after_the_resumed_step_are_dropped(tmp_path: Path) -> None:
    log = Log(tmp_path, 0)
    for step in (1, 2, 3):
        log.collect({"loss": torch.tensor(float(step))}, 0.1)
        log.write(step, "s")
    log.close()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 4, "lo')  # cut off by a kill
    Log(tmp_path, 2).close()
    assert [row["step"] for row in rows(tmp_path)] == [1, 2]


def test_scalars_go_to_tensorboard(tmp_path: Path) -> None:
    log = Log(tmp_path, 0)
    log.scalar("rate", 1.0, 1)
    log.close()
    assert list((tmp_path / "tensorboard").glob("events*"))
