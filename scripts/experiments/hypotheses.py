#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""What `quick` gains by more hypotheses, beside `refine`: accuracy against time, on `val`.

    python scripts/experiments/hypotheses.py RUN DATA [CLOUDS] [PICTURE.png]

Prints a table, one row for each number of hypotheses and one for `refine`: the share of clouds
whose base is right (within 30 degrees) and turned (off by more than 150), S, D and R of the
benchmark, and milliseconds of processor time for each cloud at batch 32 on one thread. Frames are
calibrated on training clouds, which `refine` predicts.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from bench.matching import apply_calibration, fit_calibration
from bench.methods import load
from bench.metrics import sample_errors
from scapo.categories import CATEGORIES
from scapo.method import Mode, evenly
from scapo.records import cat, take
from scapo.registered.method import AbstractRegistered
from scapo.store import open_split
from scapo.store.samples import SampleDataset, label, observe
from scapo.types import Labels, Observation, Prediction

COUNTS = (1, 4, 12, 32, 64)
CALIBRATED = 50
"""Training clouds that the frames are calibrated on."""
BATCH = 32
RIGHT, TURNED = 30.0, 150.0


def clouds(folder: Path, category: str, split: str, count: int) -> tuple[Observation, Labels]:
    """Evenly spread clouds of a split."""
    samples = SampleDataset(open_split(folder, category, split))
    batch = samples.batch(evenly(len(samples), count))
    return observe(batch), label(batch)


def predicted(
    method: AbstractRegistered, observation: Observation, mode: Mode
) -> tuple[Prediction, float]:
    """Predictions, and milliseconds of processor time for each cloud."""
    method.predict(take(observation, torch.arange(1)), mode)  # what is drawn once is drawn now
    parts = torch.arange(len(observation.points)).split(BATCH)
    started = time.process_time()
    answers = [method.predict(take(observation, index), mode) for index in parts]
    spent = time.process_time() - started
    return cat(answers), 1000 * spent / len(observation.points)


def poses(answer: Prediction | Labels) -> np.ndarray:
    """camera_T_part, (B, P, 4, 4)."""
    if answer.camera_T_part is None:
        raise ValueError("expected poses, found none")
    return answer.camera_T_part.numpy()


def errors(
    category: str, answer: Prediction, truth: Labels, offsets: np.ndarray, scale: np.ndarray
) -> dict[str, np.ndarray]:
    """`sample_errors` of calibrated predictions."""
    symmetry = CATEGORIES[category].symmetry
    joints, true = answer.joints, truth.joints
    if joints is None or true is None or truth.part is None:
        raise ValueError("expected joints and parts, found none")
    return sample_errors(
        part_true=truth.part.numpy(),
        camera_T_part_true=poses(truth),
        pivot_true=true.pivot.numpy(),
        axis_true=true.axis.numpy(),
        part_pred=answer.part_weight.numpy(),
        camera_T_part_pred=apply_calibration(poses(answer), offsets, scale=scale),
        pivot_pred=joints.pivot.numpy(),
        axis_pred=joints.axis.numpy(),
        symmetry=None if symmetry is None else np.array(symmetry, dtype=float),
    )


def lengths(observation: Observation) -> np.ndarray:
    """Four mean radii of each cloud, m: the unit of the benchmark's lengths."""
    points = observation.points
    return (4 * (points - points.mean(1, keepdim=True)).norm(dim=-1).mean(1)).numpy()


def main(run: Path, data: Path, count: int, picture: Path | None) -> None:
    """Print the table, and draw the curve if asked."""
    torch.set_num_threads(1)
    method, header = load(run)
    if not isinstance(method, AbstractRegistered):
        raise ValueError(f"{run}: expected a run of a registered method, found {method.name}")
    category = header["category"]
    train, known = clouds(data, category, "train", CALIBRATED)
    val, truth = clouds(data, category, "val", count)
    print("| hypotheses | right | turned | S | D | R | R, median | ms |\n|" + 8 * "---|")
    modes: list[tuple[str, Mode, int]] = [(str(n), "quick", n) for n in COUNTS]
    rows = list[tuple[int, float, float]]()
    found, _ = predicted(method, train, "refine")
    offsets = fit_calibration(poses(found), poses(known), scale=lengths(train))
    for name, mode, number in [*modes, ("`refine`", "refine", 0)]:
        beside = max(number, 1) - 1
        method.config = replace(method.config, quick_hypotheses=beside + 1, quick_beside=beside)
        answer, spent = predicted(method, val, mode)
        wrong = errors(category, answer, truth, offsets, lengths(val))
        base, turned = wrong["part_rotation"][:, 0], wrong["part_rotation"]
        rows.append((number, float(np.nanmean(turned)), spent))
        print(
            f"| {name} | {100 * np.mean(base < RIGHT):.1f} | {100 * np.mean(base > TURNED):.1f} "
            f"| {100 * np.nanmean(wrong['iou']):.1f} | {np.nanmean(wrong['joint_direction']):.1f} "
            f"| {np.nanmean(turned):.1f} | {np.nanmedian(turned):.1f} | {spent:.1f} |",
            flush=True,
        )
    if picture is not None:
        draw(rows, category, picture)


def draw(rows: list[tuple[int, float, float]], category: str, picture: Path) -> None:
    """The curve: rotation of the parts against milliseconds."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
    quick = [row for row in rows if row[0]]
    axes.plot([row[2] for row in quick], [row[1] for row in quick], "o-", label="quick")
    for number, angle, spent in quick:
        axes.annotate(str(number), (spent, angle), textcoords="offset points", xytext=(4, -10))
    axes.plot(*[[row[k] for row in rows if not row[0]] for k in (2, 1)], "s", label="refine")
    axes.set(
        xlabel="ms of one core for each cloud", ylabel="R, degrees", ylim=(0, None), title=category
    )
    axes.legend()
    figure.savefig(picture, dpi=100)


if __name__ == "__main__":
    given = sys.argv[1:]
    main(
        Path(given[0]),
        Path(given[1]),
        int(given[2]) if len(given) > 2 else 300,
        Path(given[3]) if len(given) > 3 else None,
    )
