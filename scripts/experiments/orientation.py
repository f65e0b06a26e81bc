# SPDX-License-Identifier: MIT
"""What a scorer of how objects stand is worth beside the loss, by who teaches it.

The hypotheses of a trained model are ranked by its loss alone, and with the charge of a scorer that
learned from training clouds as the model placed them, from their true poses, and from objects that
say themselves how they stand, be their frames trusted or not (how widely their cameras spread is
logged). Base rotations within 30 degrees of the truth count as right, after the constant turn
between the two frames that fits most.

    python scripts/experiments/orientation.py RUN DATA/sensor drawer [CLOUDS]
"""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from pathlib import Path

import torch

import scapo
from scapo import store
from scapo.geometry.points import normalise
from scapo.geometry.rigid import rotation_angle
from scapo.method import evenly
from scapo.records import cat, take
from scapo.registered import object_frames
from scapo.registered.method import TemplateRegistration
from scapo.registered.object_frames import ASKED, taught_by_objects
from scapo.registered.objects import grouped, one_object, owned_views, surest_first
from scapo.registered.orientation import CHARGE, MOST, OrientationScorer, quarter_turns
from scapo.registered.outliers import inlier_mask, replaced
from scapo.registered.pose_search import (
    CHARGED,
    Hypotheses,
    SearchSpace,
    most_confident,
    search,
)
from scapo.registered.synchronisation import densest
from scapo.registered.views import PartialViews, observe

VAL = 200  # Clouds that are ranked
RIGHT = 30.0  # Degrees
SURE = 0.7  # Share of the placed clouds, the surest, that teach
CHUNK = 200  # Clouds that are looked at at once
PRICES = (0.0125, 0.025, CHARGE)  # Loss that one nat costs


def load(data: Path, category: str, split: str, count: int) -> tuple[PartialViews, torch.Tensor]:
    """Views and true rotations of the base."""
    dataset = store.dataset(data, category, split)
    some = [dataset[int(k)] for k in evenly(len(dataset), count)]
    cloud = torch.stack([torch.as_tensor(one["points"]) for one in some]).float()
    pose = torch.stack([torch.as_tensor(one["camera_T_part"])[0] for one in some]).float()
    views = []
    for part in cloud.split(CHUNK):
        points, similarity = normalise(replaced(part, inlier_mask(part)))
        views.append(observe(points, -similarity.centre * similarity.scale[:, None]))
    return cat(views), pose[:, :3, :3]


def tell(name: str, found: torch.Tensor, truth: torch.Tensor, frame: torch.Tensor) -> None:
    """Share of right ones, median and mean error of chosen rotations (B, 3, 3)."""
    off = rotation_angle(found @ frame, truth).rad2deg()
    right = 100 * float((off < RIGHT).float().mean())
    print(f"{name:28} right {right:5.1f} %, median {off.median():5.1f}, mean {off.mean():5.1f}")


def by_objects(
    method: TemplateRegistration, data: Path, category: str, space: SearchSpace
) -> OrientationScorer:
    """What objects of the training split teach, however their cameras lie."""
    object_frames.SPREADS = 0.0, torch.inf
    dataset, config = store.dataset(data, category, "train"), method.config.discovery
    kinds, generator = method.template.kinds, torch.Generator().manual_seed(1)
    instance = torch.tensor([int(dataset[k]["instance"]) for k in range(len(dataset))])
    first = [
        method._of_one_size(torch.stack([dataset[int(k)]["points"] for k in rows]))
        for rows in grouped(instance, config)
    ]
    known = surest_first([one_object(views, kinds, config, generator) for views in first])
    shown = owned_views(known, kinds)
    asked = shown.some(ASKED)
    hypotheses = search(method.template, asked.views, space)
    scorer = taught_by_objects(shown, asked, hypotheses, generator)
    if scorer is None:
        raise AssertionError("however their cameras lie, they teach")
    return scorer


@torch.no_grad()
def main(run: Path, data: Path, category: str, clouds: int) -> None:
    """Print a line for each teacher."""
    method = scapo.load(run).model
    if not isinstance(method, TemplateRegistration):
        raise ValueError(f"{run}: expected a run of registered, found {method.name}")
    space, limits = replace(method._space(), scorer=None), method._limits().wider(CHARGED)
    train, known = load(data, category, "train", clouds)
    val, truth = load(data, category, "val", VAL)
    placed = search(method.template, train, space).best(limits)
    frame, _ = densest(placed.placement.rotation.mT @ known, torch.ones(len(known)))
    sure = most_confident(placed, SURE)
    made: Hypotheses = search(method.template, val, space)
    turns = made.placement.rotation.unflatten(0, made.loss.shape)
    off = rotation_angle(turns @ frame, truth[:, None].expand_as(turns)).rad2deg()
    print(f"right among the hypotheses: {100 * float((off.amin(1) < RIGHT).float().mean()):.1f} %")
    tell("loss alone", made.best(limits).placement.rotation, truth, frame)
    by_views = OrientationScorer().learn(
        take(train, sure), placed.placement.rotation[sure], torch.Generator().manual_seed(1)
    )
    by_truth = OrientationScorer().learn(train, known @ frame.mT, torch.Generator().manual_seed(1))
    teachers = {
        "as the model places": by_views,
        "objects": by_objects(method, data, category, space),
        "true poses": by_truth,
    }
    for name, scorer in teachers.items():
        nats = (-scorer(val, turns).log_softmax(-1)).clamp_max(MOST)
        for price in PRICES:
            charged = replace(made, unlike=made.unlike + price * nats)
            tell(f"{name}, {price}", charged.best(limits).placement.rotation, truth, frame)
        score = scorer(val, (truth @ frame.mT)[:, None] @ quarter_turns())
        first = 100 * float((score.argmax(1) == 0).float().mean())
        print(f"{'':28} the true turn before the 23 others: {first:.1f} %")


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], int((*sys.argv[4:], "1000")[0]))
