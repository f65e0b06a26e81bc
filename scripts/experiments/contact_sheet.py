# SPDX-License-Identifier: MIT
"""Draw procedural instances of a category half open, as shaded ray casts, on one sheet.

python scripts/experiments/contact_sheet.py CATEGORY OUT.png [--split train] [--seed 2] [--count 12]
"""

from __future__ import annotations

import argparse
from math import radians
from pathlib import Path

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from PIL import Image, ImageDraw

from scapo.categories import CATEGORIES
from sim_assets.objects import ArticulatedObject
from sim_assets.procedural import generate

LIGHT = np.array([-0.55, -0.35, 0.76])


def shaded(
    obj: ArticulatedObject, share: float, size: int, view: tuple[float, float]
) -> Image.Image:
    """One picture: joints at `share` of their travel, seen from azimuth and elevation (degrees)."""
    poses = obj.pose(share * obj.upper)
    corners, colors = [], []
    for part, pose in zip(obj.visuals, poses, strict=True):
        for visual in part:
            corners.append(np.asarray(visual.mesh.triangles) @ pose[:3, :3].T + pose[:3, 3])
            colors.append(np.tile(visual.color[:3], (len(visual.mesh.faces), 1)))
    triangles, color = np.concatenate(corners), np.concatenate(colors)
    points = triangles.reshape(-1, 3)
    middle = (points.min(0) + points.max(0)) / 2
    azimuth, elevation = map(radians, view)
    away = np.array([-np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation),
                     np.sin(elevation)])  # fmt: skip
    right = np.cross([0, 0, 1.0], away)
    right /= np.linalg.norm(right)
    up = np.cross(away, right)
    reach = 1.05 * max(
        np.abs((points - middle) @ right).max(), np.abs((points - middle) @ up).max()
    )
    line = (np.arange(size) + 0.5) / size * 2 - 1
    u, v = np.meshgrid(line * reach, -line * reach)
    start = middle + 3 * away + u[..., None] * right + v[..., None] * up
    origins = start.reshape(-1, 3).astype(np.float32)
    rays = np.tile(-away, (len(origins), 1)).astype(np.float32)
    scene = EmbreeScene()
    TriangleMesh(scene, triangles.astype(np.float32))
    hit = scene.run(origins, rays)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-15)
    light = 0.35 + 0.35 * np.clip(normal @ LIGHT, 0, 1) + 0.3 * np.abs(normal @ away)
    image = np.ones((len(hit), 3))
    image[hit >= 0] = (color * light[:, None])[hit[hit >= 0]]
    image = image.reshape(size // 2, 2, size // 2, 2, 3).mean((1, 3))
    return Image.fromarray((np.clip(image, 0, 1) * 255).astype(np.uint8))


def main() -> None:
    """Draw the sheet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("category", choices=CATEGORIES)
    parser.add_argument("out", type=Path)
    parser.add_argument("--split", default="train")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--size", type=int, default=220)
    given = parser.parse_args()
    columns = 6
    rows = -(-given.count // columns)
    sheet = Image.new("RGB", (columns * given.size, rows * (given.size + 14)), "white")
    writing = ImageDraw.Draw(sheet)
    for k in range(given.count):
        obj = generate(given.category, given.split, given.seed, given.first + k)
        side = (35.0, -35.0)[k % 2]
        flat = given.category in ("scissors", "eyeglasses", "laptop")
        picture = shaded(obj, 0.45, 2 * given.size, (side, 50.0 if flat else 25.0))
        place = (k % columns * given.size, k // columns * (given.size + 14))
        sheet.paste(picture, (place[0], place[1] + 14))
        writing.text((place[0] + 4, place[1]), f"{given.first + k} {obj.trait}", fill="black")
    sheet.quantize(64).save(given.out, optimize=True)


if __name__ == "__main__":
    main()
