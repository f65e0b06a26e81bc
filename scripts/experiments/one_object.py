# SPDX-License-Identifier: MIT
"""How well objects are known from their own views, and how their frames go together.

For each object of a training split, as `train registered --supervision instance` begins: share of
its views whose poses agree with the truth within 30 degrees, and the angle of its best axis to the
true one; then how many of the surest are brought to one frame.

    python scripts/experiments/one_object.py DATA/clean washer [SEED]
"""

from __future__ import annotations

import sys

import torch

from scapo import store
from scapo.categories import CATEGORIES, JointKind
from scapo.geometry.points import normalise
from scapo.geometry.rigid import axis_angle, project_rotation, rotation_angle
from scapo.registered.config import DiscoveryConfig
from scapo.registered.objects import SURE, agreeing, grouped, one_object, surest_first
from scapo.registered.outliers import inlier_mask, replaced
from scapo.registered.views import PartialViews, observe

RIGHT = 30.0  # Degrees


def middle(turns: torch.Tensor) -> torch.Tensor:
    """The rotation that most of them are near, (3, 3)."""
    near = rotation_angle(
        turns[:, None].expand(-1, len(turns), 3, 3), turns.expand(len(turns), -1, 3, 3)
    )
    best = (near.rad2deg() < RIGHT).float().sum(1).argmax()
    return project_rotation(turns[near[best].rad2deg() < RIGHT].mean(0))


def of_one_size(cloud: torch.Tensor) -> PartialViews:
    """Views of one object from clouds (B, N, 3), metres, normalised all alike."""
    points, similarity = normalise(replaced(cloud, inlier_mask(cloud)))
    views = observe(points, -similarity.centre * similarity.scale[:, None])
    return views.scaled(similarity.scale.median() / similarity.scale)


def main(data: str, category: str, seed: int) -> None:
    """Print a line for each object, the surest first, and one for all of them."""
    split, config = store.dataset(data, category, "train"), DiscoveryConfig()
    kinds: tuple[JointKind, ...] = tuple(joint.kind for joint in CATEGORIES[category].joints)
    instance = torch.tensor([int(split[k]["instance"]) for k in range(len(split))])
    shown, truth = (
        list[PartialViews](),
        dict[tuple[float, ...], tuple[torch.Tensor, torch.Tensor]](),
    )
    for rows in grouped(instance, config):
        some = [split[int(k)] for k in rows]
        views = of_one_size(torch.stack([torch.as_tensor(one["points"]) for one in some]).float())
        shown.append(views)
        for one, first in zip(some, views.points[:, 0].tolist(), strict=True):
            pose = torch.as_tensor(one["camera_T_part"][0]).float()
            truth[tuple(first)] = pose[:3, :3], torch.as_tensor(one["joint_axis"]).float()
    generator = torch.Generator().manual_seed(seed)
    known = surest_first([one_object(views, kinds, config, generator) for views in shown])
    known = known[: round(SURE * len(known))]
    frames = []
    for one, reading in zip(known, agreeing(known, kinds), strict=True):
        posed = one.posed
        poses, axes = zip(
            *(truth[tuple(p)] for p in posed.views.points[:, 0].tolist()), strict=True
        )
        turns = posed.rotation.mT @ torch.stack(poses)  # own frame from the object's
        frame = middle(turns)
        off = rotation_angle(turns, frame.expand_as(turns)).rad2deg()
        axis = frame @ (torch.stack(poses).mT @ torch.stack(axes).mT).mean(0).mT[0]
        lean = float(axis_angle(one.proposals[0][0].axis, axis / axis.norm()).rad2deg())
        share = 100 * float((off < RIGHT).float().mean())
        lean = min(lean, 180 - lean)
        print(f"views right {share:.0f} %, best axis of the first joint off by {lean:.1f}")
        frames.append(reading.turn @ frame)
    turns = torch.stack(frames)
    off = rotation_angle(turns, middle(turns).expand_as(turns)).rad2deg()
    print(f"{int((off < RIGHT).sum())} of {len(off)} objects in one frame")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 1)
