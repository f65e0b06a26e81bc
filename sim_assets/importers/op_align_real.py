# SPDX-License-Identifier: MIT
"""OP-Align's real set: `<category>_output/{train|test}/<instance>/<state>/input_2/<time>.npz`.

One file is one RGB-D view, a pickled dict under `arr_0`: `pc` (480 x 640 points in
decimetres, camera looking along -z, zeros where invalid), `color` in [0, 1], `detection` (an
object mask of a detector), `segmentation` (0 background, 1..P parts), `part` (P rows of rotation 9,
translation 3, size 3), `joint` (J rows of pivot 3, then direction 3: the set's README states the
opposite order, its loader and notebook this one).

Brought to our conventions: metres, OpenCV camera frame. Every valid point inside `detection` stays,
those labelled 0 as background. The part frames are the set's own rest frames, turned by a constant
per category so that the swap symmetry is ours; they are not our object frame, whose offset from
them nobody knows. Joint states and visible shares are unknown: NaN. The direction of a joint need
not be the one that opens. The camera row is fitted to the points' places in the image, which a
pinhole fixes; where the fit is poor it is the nominal one of the benchmark's sensor.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from scapo.categories import category as find_category
from sim_assets.formats.archives import read_npz
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
from sim_assets.models.validate import refuse

SET: str = "op-align-real"
ENDING = ".npz"
LAYOUT = "laptop_output/train/INSTANCE/STATE/input_2/TIME.npz"
METRES = 0.1
WIDTH, HEIGHT = 640, 480
CATEGORIES = {
    "basket_output": "basket",
    "drawer_output": "drawer",
    "laptop_output": "laptop",
    "suitcase_output": "suitcase",
    "scissor_output": "scissors",
    "scissors_output": "scissors",
}
NOMINAL = (600.0, 600.0, WIDTH / 2, HEIGHT / 2, float(WIDTH), float(HEIGHT))
MAX_MISFIT = 2.0
"""Pixels, root mean square: above it the places of the points say nothing about the camera."""
CYCLE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""theirs_R_ours where their symmetry is a half turn about y: our x is their y, our y their z."""
TURNS = {"laptop": CYCLE, "suitcase": CYCLE}


def find(path: Path) -> list[CloudFile]:
    """The files of the set below a path.

    Raises:
        AssetError: No such folder, or no `.npz` file in it.
    """
    return [_file(file) for file in find_files(path, ENDING)]


def _file(path: Path) -> CloudFile:
    """Category, split and instance from the folders; a misplaced file has no category."""
    parts = (*path.parent.resolve().parts, path.name)  # be the file itself a link to anywhere
    for k in range(len(parts) - 3, -1, -1):
        if parts[k] in CATEGORIES and parts[k + 1] in ("train", "test"):
            return CloudFile(
                path=path,
                name="/".join(parts[k:]),
                category=CATEGORIES[parts[k]],
                split=parts[k + 1],
                instance=parts[k + 2],
            )
    return CloudFile(path=path, name=path.name, category="", split="", instance="")


def read(file: CloudFile, data: bytes) -> RawCloud:
    """One view.

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
    category = find_category(file.category)
    members = read_npz(path, data)
    record = members.get("arr_0", members)
    part, joint = shaped(path, record, "part", ("P", 15)), shaped(path, record, "joint", ("J", 6))
    check_counts(path, category, len(part), len(joint))
    part, joint = finite(path, "part", part), finite(path, "joint", joint)
    cloud = shaped(path, record, "pc", (WIDTH * HEIGHT, 3))
    inside = shaped(path, record, "detection", (WIDTH * HEIGHT,)).astype(bool)
    kept = np.isfinite(cloud).all(1) & cloud.any(1) & inside
    if not kept.any():
        raise refuse(path, "points inside 'detection'", "none")
    segmentation = shaped(path, record, "segmentation", (WIDTH * HEIGHT,))[kept]
    label = labels(path, "segmentation", segmentation, len(part))
    color = finite(path, "color", shaped(path, record, "color", (WIDTH * HEIGHT, 3))[kept])
    poses = rigid(path, "part", part[:, :9].reshape(-1, 3, 3), part[:, 9:12] * METRES)
    return RawCloud(
        points=flipped(cloud[kept].astype(np.float64)) * METRES,
        part=np.where(label == 0, 255, label - 1).astype(np.uint8),
        color=np.round(color.clip(0, 1) * 255).astype(np.uint8),
        camera_T_part=turned(poses, TURNS.get(file.category, np.eye(3))),
        pivot=flipped(joint[:, :3]) * METRES,
        axis=flipped(units(path, "joint", joint[:, 3:])),
        state=np.full(len(joint), np.nan),
        visible=np.full(len(part), np.nan),
        camera=fit_camera(flipped(cloud.astype(np.float64)), kept),
    )


def fit_camera(
    points: Float[np.ndarray, "M 3"], valid: Bool[np.ndarray, " M"]
) -> tuple[float, float, float, float, float, float]:
    """fx, fy, cx, cy, width, height of the pinhole that puts pixel k's point at pixel k.

    Pixel centres lie at half integers. Least squares of column = fx x / z + cx, and of the row.

    Args:
        points: One per pixel, row by row; OpenCV camera frame, any unit.
        valid: Those to use.
    """
    place = np.flatnonzero(valid & (np.nan_to_num(points[:, 2]) > 0))
    if len(place) < 100:
        return NOMINAL
    ratio = points[place, :2] / points[place, 2:]
    pixel = np.stack([place % WIDTH, place // WIDTH], 1) + 0.5
    focal, centre, misfit = np.zeros(2), np.zeros(2), np.zeros(2)
    for k in range(2):
        columns = np.stack([ratio[:, k], np.ones(len(place))], 1)
        (focal[k], centre[k]), *_ = np.linalg.lstsq(columns, pixel[:, k], rcond=None)
        misfit[k] = np.sqrt(np.mean((columns @ [focal[k], centre[k]] - pixel[:, k]) ** 2))
    if not (focal > 0).all() or not (misfit < MAX_MISFIT).all():
        return NOMINAL
    fx, fy, cx, cy = (float(value) for value in (*focal, *centre))
    return fx, fy, cx, cy, float(WIDTH), float(HEIGHT)
