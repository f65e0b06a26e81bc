#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""How far hinges are from the true ones: of views one by one, and of objects by all of their views.

    python scripts/experiments/hinges.py MODEL DATA CATEGORY [CLOUDS]

`quick` places the first clouds of `train`, every second one: 25 of an object. Prints the mean and
the median distance from the true axes in 4 mean radii, of the hinges that the placements have and
of those that each object's views tell together. Labels measure, no more. Of two hinges the order
that is nearer counts.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor

from bench.methods import load
from scapo.geometry.rigid import point_line_distance
from scapo.records import cat, take
from scapo.registered.hinges import hinges_of_objects
from scapo.registered.method import TemplateRegistration
from scapo.registered.objects import rows_by_object
from scapo.registered.template import turn_placement
from scapo.store import open_split
from scapo.store.samples import SampleDataset, label, observe

AT_A_TIME, EVERY = 50, 2
"""Clouds that are placed together, and that every second one is looked at, as in training."""


@torch.no_grad()
def main(run: Path, data: Path, category: str, count: int) -> None:
    """Print both."""
    torch.set_num_threads(1)
    method, _ = load(run)
    if not isinstance(method, TemplateRegistration):
        raise ValueError(f"{run}: expected a run of registered, found {method.name}")
    samples = SampleDataset(open_split(data, category, "train"))
    batch = samples.batch(torch.arange(0, EVERY * count, EVERY))
    observation, labels = observe(batch), label(batch)
    if labels.joints is None or labels.instance is None:
        raise ValueError(f"{data}: expected joints and which clouds show one object, found none")
    template, placed, scales = method.template, [], []
    for row in torch.arange(len(labels.instance)).split(AT_A_TIME):
        seen = method._seen(take(observation, row))
        placed.append(turn_placement(method._searched(seen, "quick").placement, seen.frame.mT))
        scales.append(seen.similarity)
    placement, similarity = cat(placed), cat(scales)
    base = similarity.inverse(placement.translation[:, None])
    true = (labels.joints.pivot - base) @ placement.rotation
    axis = labels.joints.axis @ placement.rotation
    centred = observation.points - observation.points.mean(1, keepdim=True)
    unit = 4 * centred.norm(dim=-1).mean(1)

    def tell(name: str, pivot: Tensor) -> None:
        metres = pivot / similarity.scale[:, None, None]
        off = [point_line_distance(some, true, axis) for some in (metres, metres.flip(1))]
        least = torch.where((off[1].mean(1) < off[0].mean(1))[:, None], off[1], off[0])
        least = least / unit[:, None]
        print(f"{name}: mean {least.mean():.4f}, median {least.median():.4f}")

    found = hinges_of_objects(
        template, placement, similarity.scale, rows_by_object(labels.instance)
    )
    tell("one by one", template.pivots(placement))
    tell("of objects", found.pivot)
    print(f"trusted: {100 * (found.trust > 0.5).float().mean():.0f} %")


if __name__ == "__main__":
    main(
        Path(sys.argv[1]),
        Path(sys.argv[2]),
        sys.argv[3],
        int(sys.argv[4]) if len(sys.argv) > 4 else 500,
    )
