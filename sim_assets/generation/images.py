# SPDX-License-Identifier: MIT
"""Pictures of a shard's samples, beside it: `images/00000/0003.png` is that of row 3 of shard 0.

Depth, `.mask.png` and `.rgb.png`, and the camera in `intrinsics.json`: what `scapo-bench infer`
looks for beside a depth image.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from scapo.geometry.camera import Intrinsics
from scapo.store.folders import made_here, whole_folder
from sim_assets.sampling.images import PREFIX
from sim_assets.sampling.samples import Row

FOLDER = "images"
SUFFIXES = {"depth": ".png", "mask": ".mask.png", "rgb": ".rgb.png"}
CAMERA = "intrinsics.json"


def image_folder(shard: Path) -> Path:
    """Where the pictures of a shard lie."""
    return shard.parent / FOLDER / shard.stem


def write_images(shard: Path, rows: Sequence[Row], camera: Intrinsics) -> list[Row]:
    """Write the pictures among the rows, if there are any, and give the rows without them.

    The folder appears whole, before the shard does.

    Raises:
        ValueError: A folder of somebody else is in the way.
        OSError: It cannot be written.
    """
    if any(name.startswith(PREFIX) for row in rows for name in row):
        from PIL import Image

        with whole_folder(image_folder(shard)) as folder:
            text = json.dumps(asdict(camera), indent=1) + "\n"
            (folder / CAMERA).write_text(text, encoding="utf-8")
            for number, row in enumerate(rows):
                for name, suffix in SUFFIXES.items():
                    if PREFIX + name in row:
                        image = Image.fromarray(row[PREFIX + name])
                        image.save(folder / f"{number:04d}{suffix}")
    return [{k: v for k, v in row.items() if not k.startswith(PREFIX)} for row in rows]


def has_images(shard: Path, count: int) -> bool:
    """Whether all pictures of a finished shard are there as they were written."""
    folder = image_folder(shard)
    return made_here(folder) and len(list(folder.glob(f"*{SUFFIXES['mask']}"))) == count


def remove_unfinished(split: Path) -> None:
    """Remove what a run left that was killed while it wrote pictures."""
    for folder in (split / FOLDER).glob(".*"):
        shutil.rmtree(folder, ignore_errors=True)
