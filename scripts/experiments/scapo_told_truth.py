# SPDX-License-Identifier: MIT
"""What SCAPO's networks and losses keep of a perfect start: labels in place of a run that tells.

Preset `warm` learns the frames, shapes, joints and states that a trained run says of the training
clouds, and goes on with the paper's losses. Here the labels say them: of each training cloud the
true frame of its base, its joints and states, and one object's shape, each part stretched to the
box of the cloud's own. So what stage 2 does to a start that is right is seen apart from how a
start is found. Labels enter the fit: a diagnosis, no method.

    python scripts/experiments/scapo_told_truth.py DATA/complete CATEGORY RUN [OPTIONS OF train]
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

import bench.__main__
from scapo import store
from scapo.categories import CATEGORIES, Category
from scapo.geometry.points import ends
from scapo.geometry.rigid import apply, invert, joint_motion
from scapo.method import Mode
from scapo.paper import method as paper
from scapo.paper.warm_start import POINTS
from scapo.records import take
from scapo.store.samples import read_training_data
from scapo.types import Observation, Prediction

LABELS = ("part", "camera_T_part", "joints")
LEAST_SIDE = 0.01  # Metres: of a part's box, thinner ones are not stretched
STRETCH = 4.0  # Times, at most


class Truth:
    """Answers as a trained run does, from the labels of the clouds that it is asked for."""

    name = "truth"
    supervision: frozenset[str] = frozenset()

    def __init__(self, data: Path, category: Category) -> None:
        known = read_training_data(store.open_split(data, category.name, "train"))
        part, pose, joints = (getattr(known.labels, name) for name in LABELS)
        if part is None or pose is None or joints is None:
            raise ValueError(f"{data}: expected poses, parts and joints, found none")
        self.category, self.joints = category, joints
        self.points, self.part, self.pose = known.observation.points, part, pose
        self.row = {tuple(one.tolist()): k for k, one in enumerate(self.points[:, 0])}
        shares = torch.stack([(part == p).float().mean(1) for p in range(len(category.parts))])
        self.model = int(shares.amin(0).argmax())  # Whose smallest part shows the most points
        self.shape = self.at_rest(self.model)

    def at_rest(self, row: int) -> Float[Tensor, "N 3"]:
        """A cloud in the frame of its base with its joints at rest."""
        base, joints = invert(self.pose[row, 0]), self.joints
        rest = apply(base[None], self.points[None, row])[0]
        pivot = apply(base[None], joints.pivot[None, row])[0]
        axis = joints.axis[row] @ base[:3, :3].T
        for j, joint in enumerate(self.category.joints):
            back = joint_motion(pivot[j], axis[j], -joints.state[row, j], joint.kind)
            moved = apply(back[None], rest[None])[0]
            rest = torch.where((self.part[row] == j + 1)[:, None], moved, rest)
        return rest

    def stretched(self, row: int) -> Float[Tensor, "M 3"]:
        """The model's points, each part in the box of the cloud's own part."""
        rest = self.at_rest(row)
        part, made = self.part[self.model], self.shape[:POINTS].clone()
        for p in range(len(self.category.parts)):
            own, model = rest[self.part[row] == p], self.shape[part == p]
            if len(own) < 2:
                continue
            low, high = ends(own)
            first, last = ends(model)
            size = ((high - low) / (last - first).clamp_min(LEAST_SIDE)).clamp(1 / STRETCH, STRETCH)
            size = torch.where(last - first < LEAST_SIDE, 1.0, size)
            placed = (self.shape[:POINTS] - (first + last) / 2) * size + (low + high) / 2
            made = torch.where((part[:POINTS] == p)[:, None], placed, made)
        return made

    def predict(self, observation: Observation, mode: Mode) -> Prediction:
        """The labels of training clouds."""
        del mode
        rows = torch.tensor([self.row[tuple(one.tolist())] for one in observation.points[:, 0]])
        return Prediction(
            part_weight=torch.ones(len(rows), 1, 1),
            camera_T_part=self.pose[rows],
            joints=take(self.joints, rows),
            canonical_points=torch.stack([self.stretched(int(row)) for row in rows]),
            canonical_part=self.part[self.model, :POINTS].expand(len(rows), -1),
        )


def main(data: Path, category: str, run: Path, options: list[str]) -> None:
    """Train `warm` for whole surfaces, told by the labels."""
    truth = Truth(data, CATEGORIES[category])
    paper.load_run = lambda *_: truth
    sys.argv = [
        "scapo-bench", "train", "scapo", "--preset", "warm", "--loss.recon-form", "squared",
        "--start", "labels", "--category", category, "--data", str(data), "--out", str(run),
        *options,
    ]  # fmt: skip
    bench.__main__.main()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), sys.argv[4:])
