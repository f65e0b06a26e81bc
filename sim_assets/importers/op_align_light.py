# SPDX-License-Identifier: MIT
"""OP-Align's "Light" clouds: `pc/{full|partial}/<category>/{train|test}/<index>.pt`.

One file is a torch dict (docs/protocol.md): `pc` (N,3), `label` (N) 0..P-1, `part_pv_point` and
`part_axis` (J,3), `pose_segs` (P,4,4), `idx`; index = instance number x 100 + state number. The
diagonal of the box at rest is 1, the origin is the mean of the object's points: the camera of the
partial clouds stood at an unknown place along +z, and full clouds have none.

Brought to our conventions: OpenCV axes; metres by the category's nominal diagonal. The last entry
of `pose_segs` of parts that stand still is 0 where 1 belongs: it is set to 1, and such a part is
the base, so it comes first. Part frames are the set's rest frames, turned by a constant per
category so that the swap symmetry is ours. Where that rest is ours too (ovens, washers and
eyeglasses of Shape2Motion), the joint state is the turn between the part poses and the axis points
so that it is positive; else the state is unknown: NaN.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from scapo.categories import CATEGORIES
from sim_assets.formats.archives import read_pt
from sim_assets.importers.clouds import (
    CloudFile,
    RawCloud,
    check_counts,
    find_files,
    finite,
    flipped,
    labels,
    misplaced,
    rigid,
    shaped,
    turned,
    units,
)
from sim_assets.importers.models import our_category
from sim_assets.models.validate import refuse

SET: str = "op-align-light"
ENDING = ".pt"
LAYOUT = "pc/full/laptop_h/train/INDEX.pt"
STATES = 100
"""Files of one instance."""
CAMERA = (240 / np.tan(np.radians(30)),) * 2 + (320.0, 240.0, 640.0, 480.0)
"""Of the partial clouds: 640 x 480, 60 degrees high. Full clouds have no camera; same row."""
OUR_REST = ("oven", "washer", "eyeglasses")
_H = np.sqrt(0.5)
DIAGONAL = np.array([[_H, 0.0, -_H], [0.0, 1.0, 0.0], [_H, 0.0, _H]])
"""theirs_R_ours of laptops, whose symmetry is a half turn about (1, 0, 1): that is our x."""
TURNS = {"laptop": DIAGONAL}


def find(path: Path) -> list[CloudFile]:
    """The files of the set below a path, in the order of their indices.

    Raises:
        AssetError: No such folder, or no `.pt` file in it.
    """
    files = [_file(file) for file in find_files(path, ENDING)]
    return sorted(files, key=lambda f: (f.variant, f.category, f.split, _index(f.path) or 0))


def _index(path: Path) -> int | None:
    return int(path.stem) if path.stem.isascii() and path.stem.isdecimal() else None


def _file(path: Path) -> CloudFile:
    """Category, split and instance from the folders; a misplaced file has no category."""
    parts = (*path.parent.resolve().parts, path.name)  # be the file itself a link to anywhere
    index = _index(path)
    nowhere = CloudFile(path=path, name=path.name, category="", split="", instance="")
    if len(parts) < 4 or index is None:
        return nowhere
    name, split = parts[-3], parts[-2]
    category = our_category(name)
    if category not in CATEGORIES or split not in ("train", "test"):
        return nowhere
    kind = parts[-4] if parts[-4] in ("full", "partial") else "full"
    return CloudFile(
        path=path,
        name=f"{kind}/{name}/{split}/{index}.pt",
        category=category,
        split=split,
        instance=f"{name}-{split}-{index // STATES:03d}",
        variant=f"{kind}-{name}",
    )


def read(file: CloudFile, data: bytes) -> RawCloud:
    """One cloud.

    Args:
        file: From `find`.
        data: The file's bytes.

    Raises:
        AssetError: It is misplaced, lacks a key, or holds what cannot be.
        UnpickleError: It is damaged, or holds more than data.
    """
    path = file.path
    if not file.category:
        raise misplaced(path, LAYOUT)
    category = CATEGORIES[file.category]
    record = read_pt(path, data)
    points = finite(path, "pc", shaped(path, record, "pc", ("N", 3)))
    raw = finite(path, "pose_segs", shaped(path, record, "pose_segs", ("P", 4, 4)))
    axis = finite(path, "part_axis", shaped(path, record, "part_axis", ("J", 3)))
    check_counts(path, category, len(raw), len(axis))
    pivot = finite(path, "part_pv_point", shaped(path, record, "part_pv_point", axis.shape))
    if len(points) == 0:
        raise refuse(path, "points in 'pc'", "none")
    label = shaped(path, record, "label", (len(points),))
    order = base_first(path, raw)
    part = np.argsort(order)[labels(path, "label", label, len(raw) - 1)]
    raw = raw[order]
    scale = category.diagonal
    poses = rigid(path, "pose_segs", raw[:, :3, :3], raw[:, :3, 3] * scale)
    axis, state = _opening(file.category, poses, units(path, "part_axis", axis))
    full = file.variant.startswith("full")
    return RawCloud(
        points=flipped(points) * scale,
        part=part.astype(np.uint8),
        color=None,
        camera_T_part=turned(poses, TURNS.get(file.category, np.eye(3))),
        pivot=flipped(pivot) * scale,
        axis=flipped(axis),
        state=state,
        visible=np.full(len(raw), 1.0 if full else np.nan),
        camera=CAMERA,
    )


def base_first(path: Path, raw: Float[np.ndarray, "P 4 4"]) -> list[int]:
    """The order of the parts that puts the one that stands still first.

    Its last entry is 0 in the published files. Where all are 1 the order stays.

    Raises:
        AssetError: Last rows other than 0 0 0 1 and 0 0 0 0, or several parts that stand still.
    """
    last = raw[:, 3]
    if np.abs(last[:, :3]).max() > 1e-6 or not np.isin(last[:, 3], (0.0, 1.0)).all():
        raise refuse(path, "0 0 0 1 or 0 0 0 0 as last rows of 'pose_segs'", f"{last.tolist()}")
    still = np.flatnonzero(last[:, 3] == 0).tolist()
    if len(still) > 1:
        raise refuse(path, "one part that stands still in 'pose_segs'", f"{len(still)}")
    return still + [part for part in range(len(raw)) if part not in still]


def _opening(
    category: str, poses: Float[np.ndarray, "P 4 4"], axis: Float[np.ndarray, "J 3"]
) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, " J"]]:
    """Axes along which the states are positive, and the states; NaN where the rest is not ours."""
    state = np.full(len(axis), np.nan)
    if category not in OUR_REST:
        return axis, state
    for j in range(len(axis)):
        turn = poses[j + 1, :3, :3] @ poses[0, :3, :3].T
        sine = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        state[j] = np.arctan2(sine @ axis[j], np.trace(turn) - 1)
    sign = np.where(state < 0, -1.0, 1.0)
    return axis * sign[:, None], np.abs(state)
