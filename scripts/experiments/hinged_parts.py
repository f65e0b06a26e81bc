#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""By how much hinged parts are turned wrongly about their hinges, and what that goes with.

    scapo-bench predict oven --data DATA/clean --split val --mode quick --limit 200 --out P
    python scripts/experiments/hinged_parts.py P DATA/clean oven val

Prints, in degrees: the median error; how much of it all views of an object share; the errors by
state and by the face that is seen; and how far the plane of the part's points, as the true labels
give them, is from the truth, which is what the points could tell.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scapo.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from scapo.store import open_split
from scapo.store.files import read

WRONG = 30.0  # Degrees from which on an answer counts as a wrong pose and is left out
STATES = (0, 25, 45, 65, 120)
TRIED = np.radians(np.arange(-30, 30.5, 0.5))
FLAT = 0.006  # Metres within which points lie on one plane
LEAST = 40  # Points of a part whose plane is sought


def plane_error(points: Tensor, axis: Tensor, front: Tensor) -> float:
    """Angle about the axis at which most points lie on one plane, from the true front."""
    across = front - (front @ axis) * axis
    best, most = 0.0, 0
    for angle in TRIED:
        turned = rotvec_to_rotmat(axis * angle) @ across
        height = (points @ (turned / turned.norm())).sort().values
        shared = int((torch.searchsorted(height, height + FLAT) - torch.arange(len(height))).max())
        if shared > most:
            best, most = float(np.degrees(angle)), shared
    return best


def main(predictions: Path, data: Path, category: str, split: str) -> None:
    """Of the first joint."""
    said = read(predictions)[0]["camera_T_part"]
    names = ("camera_T_part", "joint_axis", "joint_state", "instance", "points", "part")
    arrays = open_split(data, category, split).arrays(*names)
    truth = {name: torch.as_tensor(np.asarray(array)) for name, array in arrays.items()}
    pose = torch.as_tensor(np.asarray(said)).double()
    rows = torch.isfinite(pose.flatten(1)).all(1).nonzero()[:, 0]
    own = truth["camera_T_part"][rows, 1, :3, :3].double()
    axis = truth["joint_axis"][rows, 0].double()
    turn = rotmat_to_rotvec((pose[rows, 1, :3, :3] @ own.mT).float()).double()
    error = torch.rad2deg((turn * axis).sum(-1))
    state = torch.rad2deg(truth["joint_state"][rows, 0].double())
    instance, good = truth["instance"][rows], error.abs() < WRONG
    outer, plane = torch.zeros(len(rows), dtype=torch.bool), []
    for k, row in enumerate(rows.tolist()):
        points = truth["points"][row][truth["part"][row] == 1].double()
        if len(points) >= LEAST:
            outer[k] = points.mean(0) @ own[k, :, 0] > 0  # the front faces -x at rest
            plane.append(abs(plane_error(points, axis[k], own[k, :, 0])))
    print(f"{category}: {int(good.sum())} of {len(rows)} clouds within {WRONG:.0f} degrees")
    print(f"median error {error[good].abs().median():.1f}; of planes {np.median(plane):.1f}")
    groups = [error[good & (instance == one)] for one in instance.unique()]
    means = torch.stack([some.mean() for some in groups if len(some) > 1])
    within = torch.stack([some.std() for some in groups if len(some) > 1])
    print(f"shared by an object's views: {means.std():.1f}; beside that {within.mean():.1f}")
    for low, high in pairwise(STATES):
        for face, some in (("outer", outer), ("inner", ~outer)):
            mine = good & some & (state >= low) & (state < high)
            if int(mine.sum()) > 2:
                print(f"state {low} to {high}, {face} face: {error[mine].mean():+.1f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], sys.argv[4])
