# SPDX-License-Identifier: MIT
"""What labels by the points of a told template can say at best: by how many, and by which of them.

A released model is asked about whole surfaces of `val` (`whole`). Its own canonical points are put
where it says that their parts are, so that no network's error is left, and each observed point
takes the part of the nearest of COUNT of them, or of a dozen (`points.smoothed`).

    python scripts/experiments/scapo_told_labels.py DATA/complete oven safe washer eyeglasses
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

import scapo
from scapo import store
from scapo.geometry.points import nearest, normalise, smoothed
from scapo.geometry.rigid import apply
from scapo.records import take
from scapo.store.samples import read_training_data

CLOUDS, COUNTS = 48, (256, 512, 1024)


def mean_iou(said: Tensor, true: Tensor, parts: int) -> float:
    """S of Table 1 in percent, in the order of the parts that fits a cloud best."""
    orders = []
    for order in itertools.permutations(range(parts)):
        other = torch.tensor(order)[said]
        both = [((other == p) & (true == p)).sum(1) for p in range(parts)]
        either = [((other == p) | (true == p)).sum(1).clamp_min(1) for p in range(parts)]
        orders.append(torch.stack([a / b for a, b in zip(both, either, strict=True)]).mean(0))
    return 100 * float(torch.stack(orders).amax(0).mean())


def main(data: Path, category: str) -> None:
    """Print S of the model's own labels, and of those by fewer points."""
    known = read_training_data(store.open_split(data, category, "val"))
    some = torch.arange(CLOUDS) * len(known.observation.points) // CLOUDS
    seen, true = take(known.observation, some), known.labels.part
    model = scapo.load(category).model
    said = model.predict(seen, "whole")
    surface, part, pose = said.canonical_points, said.canonical_part, said.camera_T_part
    if surface is None or part is None or pose is None or true is None:
        raise ValueError(f"{category}: expected a template, poses and labels, found some missing")
    parts, true = pose.shape[1], true[some]
    print(f"{category}: its own {mean_iou(said.part_weight.argmax(-1), true, parts):.1f}")
    _, similarity = normalise(seen.points)
    cloud = similarity.forward(seen.points)
    for count in COUNTS:
        chosen = torch.arange(count) * min(surface.shape[1], 1024) // count
        label = part[:, chosen]
        moved = torch.stack([apply(pose[:, p], surface[:, chosen]) for p in range(parts)], 1)
        at = label[:, None, :, None].expand(-1, 1, -1, 3)
        placed = similarity.forward(moved.gather(1, at)[:, 0])
        one = label.gather(1, nearest(cloud, placed))
        weights = F.one_hot(label, parts).to(cloud)
        dozen = torch.stack([smoothed(*x) for x in zip(cloud, placed, weights, strict=True)])
        scores = [mean_iou(found, true, parts) for found in (one, dozen.argmax(-1))]
        print(f"  {count} points: the nearest {scores[0]:.1f}, a dozen {scores[1]:.1f}")


if __name__ == "__main__":
    for name in sys.argv[2:]:
        main(Path(sys.argv[1]), name)
