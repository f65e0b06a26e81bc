#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""What clouds of the same views show: one picture, exact or by a sensor, parts alone, all surface.

Prints the table of docs/sensor-noise.md: `python scripts/experiments/samplings.py [VIEWS]`.

Per category and way of sampling, means over the views: `covered`, the share of the object's surface
that has a point of the cloud within 4 % of its diagonal; `hidden`, the share of points further than
that from all that the exact picture shows; `off`, median and 90th percentile of a point's distance
from the plane of the nearest surface, mm; `foreign`, the share of points that are not the object;
`least`, the share of points on the part with the fewest.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from scapo.types import Sample
from sim_assets import generate_samples
from sim_assets.objects import ArticulatedObject
from sim_assets.procedural import generate
from sim_assets.sampling.cloud import sample_surface

CATEGORIES = ("laptop", "drawer", "suitcase", "basket", "scissors")
WAYS: dict[str, dict[str, Any]] = {
    "exact picture": {},
    "sensor": {"noise": "disparity", "mask": "imperfect"},
    "`isolated`": {"protocol": "isolated", "sampling": "random"},
    "`full`": {"protocol": "full"},
}
NEAR = 0.04
MANY = 16_384
"""Points of the exact cloud that says what is shown."""
DENSE = 40_000
SURFACE = 2_000


def samples(category: str, views: int, **options: Any) -> list[Sample]:  # noqa: ANN401
    """`views` samples of as many objects as there are fives of them, by the benchmark's camera."""
    given = {"preset": "sim-art-sensor", "seed": 2, "split": "test", "backend": "auto", **options}
    return list(generate_samples(category, count=views, instances=views // 5, **given))


def surface(thing: ArticulatedObject, sample: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Points of all surfaces, uniform by area, and their normals, camera frame."""
    poses = sample.labels.camera_T_part
    assert poses is not None  # noqa: S101 - simulated samples have labels
    rng = np.random.default_rng(0)
    meshes = [thing.part_mesh(part) for part in range(len(thing.visuals))]
    area = np.array([mesh.area for mesh in meshes])
    points, normals = [], []
    for mesh, pose, count in zip(meshes, poses.numpy(), DENSE * area / area.sum(), strict=True):
        drawn, face = sample_surface(mesh, max(1, int(count)), rng)
        points.append(drawn @ pose[:3, :3].T + pose[:3, 3])
        normals.append(mesh.face_normals[face] @ pose[:3, :3].T)
    return np.concatenate(points), np.concatenate(normals)


def measure(thing: ArticulatedObject, sample: Sample, exact: Sample) -> list[float]:
    """Covered, hidden, off (two), foreign, least of one cloud."""
    near = NEAR * float(np.linalg.norm(thing.extents()))
    points, normals = surface(thing, sample)
    cloud = sample.observation.points.numpy().astype(np.float64)
    part = sample.labels.part
    assert part is not None  # noqa: S101
    own = cloud[part.numpy() >= 0]
    some = points[:: DENSE // SURFACE]
    covered = (KDTree(own).query(some)[0] < near).mean()
    shown = exact.observation.points.numpy()
    hidden = (KDTree(shown).query(own)[0] > near).mean()
    nearest = KDTree(points).query(own, k=4)[1]  # at an edge the nearest may be of another side
    gaps = ((own[:, None] - points[nearest]) * normals[nearest]).sum(-1)
    off = np.abs(gaps).min(1) * 1000
    counts = np.bincount(part.numpy()[part.numpy() >= 0], minlength=len(thing.visuals))
    foreign = 1 - len(own) / len(cloud)
    return [
        100 * covered,
        100 * hidden,
        float(np.median(off)),
        float(np.quantile(off, 0.9)),
        100 * foreign,
        100 * counts.min() / len(cloud),
    ]


def main(views: int) -> None:
    """Print a table row for each category and way."""
    print("| category | cloud | covered, % | hidden, % | off, mm (90 %) | foreign, % | least, % |")
    print("|---|---|---:|---:|---:|---:|---:|")
    for category in CATEGORIES:
        things = [generate(category, "test", 2, index) for index in range(views // 5)]
        made = {way: samples(category, views, **options) for way, options in WAYS.items()}
        shown = samples(category, views, points=MANY)
        for way, clouds in made.items():
            rows = []
            for sample, exact in zip(clouds, shown, strict=True):
                states = [one.labels.joints.state for one in (sample, exact)]  # type: ignore[union-attr]
                if (states[0] == states[1]).all():  # drawn again in one of them: another view
                    thing = things[sample.key.index // 5]
                    rows.append(measure(thing, sample, exact))
            c, h, off, far, foreign, least = np.mean(rows, axis=0)
            print(
                f"| {category} | {way} | {c:.0f} | {h:.0f} | {off:.1f} ({far:.1f}) | {foreign:.1f} "
                f"| {least:.0f} |"
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 60)
