# SPDX-License-Identifier: MIT
"""What a network is taught by `--stand objects`: how many placements are right before and after.

Of some objects of a training split, 25 views each, a trained model's candidates (what `quick` would
choose between), then those that stand as their object does (`scapo.registered.standing`). Labels
measure only: right is a base within 30 degrees of the truth after the turn that most agree on.

    python scripts/experiments/how_objects_stand.py MODEL DATA/sensor drawer [OBJECTS]
"""

from __future__ import annotations

import sys
from dataclasses import replace

import torch

from scapo import store
from scapo.categories import CATEGORIES
from scapo.geometry.rigid import rotation_angle
from scapo.method import evenly
from scapo.registered.method import load_run
from scapo.registered.pseudo_labels import Candidates
from scapo.registered.synchronisation import densest
from scapo.types import Labels

VIEWS, RIGHT = 25, 30.0


def best(found: Candidates) -> torch.Tensor:
    """Rotation of each cloud's cheapest candidate."""
    turn = found.placement.rotation.unflatten(0, found.gap.shape)
    return turn[torch.arange(len(turn)), found.gap.argmin(1)]


def main(run: str, data: str, category: str, objects: int) -> None:
    """Print a line for each object, and one for all of them."""
    model = load_run(run, CATEGORIES[category])
    model.config = replace(model.config, stand="objects")
    split = store.dataset(data, category, "train")
    instance = torch.tensor([int(split[k]["instance"]) for k in range(len(split))])
    chosen = instance.unique()[evenly(len(instance.unique()), objects)]
    every = [(instance == one).nonzero()[:, 0] for one in chosen]
    rows = torch.cat([own[evenly(len(own), VIEWS)] for own in every])
    some = [split[int(k)] for k in rows]
    cloud = torch.stack([torch.as_tensor(one["points"]) for one in some]).float()
    pose = torch.stack([torch.as_tensor(one["camera_T_part"][0]) for one in some]).float()
    truth, owner = pose[:, :3, :3], instance[rows]
    with torch.no_grad():
        found = model._candidates_of_all(cloud)
        taught, trust = model._trusted(
            found, cloud, Labels(instance=owner), torch.Generator().manual_seed(0)
        )
    before, after = (truth.mT @ best(one) for one in (found, taught))
    middle, _ = densest(before, torch.ones(len(before)))
    right = [
        rotation_angle(one, middle.expand_as(one)).rad2deg() < RIGHT for one in (before, after)
    ]
    learned, surest = trust > 0, found.surest(model.config.trusted) > 0
    for one in chosen.tolist():
        own = owner == one
        share = [float(x.float().mean()) for x in (right[0][own], right[1][own & learned])]
        print(f"object {one}: {share[0]:.2f} right, of those that are learned {share[1]:.2f}")
    print(
        f"surest {model.config.trusted:.0%}: {right[0][surest].float().mean():.3f} right; "
        f"{learned.float().mean():.0%} as objects stand: {right[1][learned].float().mean():.3f}"
    )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]) if len(sys.argv) > 4 else 8)
