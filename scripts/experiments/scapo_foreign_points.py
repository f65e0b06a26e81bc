# SPDX-License-Identifier: MIT
"""How much of the squared distance of stage 2 is of points that are not the object's.

Clouds of `val` under the simulated sensor, whose masks are imperfect, against the template as a run
of SCAPO poses it. Labels say which points are foreign; nothing is trained.

    python scripts/experiments/scapo_foreign_points.py BASE DATA/sensor scissors
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

import scapo
from scapo import store
from scapo.geometry.points import normalise, squared_distances
from scapo.paper.method import Scapo
from scapo.paper.refine import posed_template
from scapo.store.samples import read_training_data

CLOUDS = 100


@torch.no_grad()
def main(run: Path, data: Path, category: str) -> None:
    """Print the share of foreign points, and theirs of the sum of squared distances."""
    known = read_training_data(store.open_split(data, category, "val"))
    some = torch.arange(CLOUDS) * len(known.observation.points) // CLOUDS
    model, part = scapo.load(run).model, known.labels.part
    if not isinstance(model, Scapo) or part is None:
        raise ValueError(f"{run}: expected a run of scapo and labels of parts, found others")
    cloud, _ = normalise(known.observation.points[some])
    foreign = (part[some] < 0) | (part[some] >= len(model.category.parts))
    off = squared_distances(cloud, posed_template(model.explain(cloud), model.kinds))
    print(f"{100 * foreign.float().mean():.1f} % of the points are foreign")
    print(f"their share of the squared distance: {100 * off[foreign].sum() / off.sum():.0f} %")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
