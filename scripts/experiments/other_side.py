#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""Doors hinged at the other side than those of the training, where it is known which way is up.

    python scripts/experiments/other_side.py DATA CATEGORY ... [--mode quick] [--limit 200]

Asks the released models for views of `val` and for their mirror images, told which way is up, and
prints S (%), D (degrees), C, R (degrees) and t of each: answered as training has doors, and with
the side that fits better (`scapo.answer`).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import torch

import scapo
from bench.metrics import sample_errors
from scapo import answer
from scapo.alignment import unit_length
from scapo.method import evenly
from scapo.predictor import Predictor
from scapo.records import cat
from scapo.store import open_split
from scapo.store.samples import SampleDataset, label, observe
from scapo.types import FullyLabelled, Prediction

BATCH = 25


def mirror_image(view: FullyLabelled) -> FullyLabelled:
    """The same objects in a mirror."""
    said = Prediction(part_weight=view.points, camera_T_part=view.camera_T_part, joints=view.joints)
    turned = answer.mirrored(said)
    assert turned.camera_T_part is not None and turned.joints is not None  # noqa: S101, PT018
    return FullyLabelled(
        points=view.points * torch.tensor(answer.ASIDE), part=view.part, instance=view.instance,
        camera_T_part=turned.camera_T_part, joints=turned.joints,
    )  # fmt: skip


def scores(predictor: Predictor, view: FullyLabelled, mode: str) -> str:
    """S, D, C, R, t of answers to these clouds."""
    up = view.camera_T_part[:, 0, :3, 2]
    pairs = zip(view.points.split(BATCH), up.split(BATCH), strict=True)
    found = cat([predictor.predict(points, mode, up=known) for points, known in pairs])  # pyright: ignore[reportArgumentType]
    assert found.joints is not None  # noqa: S101
    errors = sample_errors(
        part_true=view.part.numpy(), camera_T_part_true=view.camera_T_part.numpy(),
        pivot_true=view.joints.pivot.numpy(), axis_true=view.joints.axis.numpy(),
        part_pred=found.part_weight.numpy(), camera_T_part_pred=np.asarray(found.camera_T_part),
        pivot_pred=found.joints.pivot.numpy(), axis_pred=found.joints.axis.numpy(),
    )  # fmt: skip
    unit = unit_length(view.points).numpy()[:, None]
    means = (
        100 * errors["iou"].mean(), errors["joint_direction"].mean(),
        (errors["joint_pivot"] / unit).mean(), errors["part_rotation"].mean(),
        (errors["part_translation"] / unit).mean(),
    )  # fmt: skip
    return "{:.1f}, {:.1f}, {:.3f}, {:.1f}, {:.3f}".format(*means)


def main() -> None:
    """Print a row for each category."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("category", nargs="+")
    parser.add_argument("--mode", default="quick")
    parser.add_argument("--limit", type=int, default=200)
    given = parser.parse_args()
    one_side: Callable[..., bool] = lambda method: False  # noqa: E731
    print("| | as training has doors | the side that fits better |")
    for category in given.category:
        samples = SampleDataset(open_split(given.data, category, "val"))
        batch = samples.batch(evenly(len(samples), given.limit))
        view = FullyLabelled.of(observe(batch), label(batch), "this script")
        predictor = scapo.load(category)
        for name, shown in (("as trained", view), ("mirror images", mirror_image(view))):
            with mock.patch.object(answer, "hangs_aside", one_side):
                before = scores(predictor, shown, given.mode)
            after = scores(predictor, shown, given.mode)
            print(f"| {category}, {name} | {before} | {after} |", flush=True)


if __name__ == "__main__":
    main()
