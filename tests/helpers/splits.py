# SPDX-License-Identifier: MIT
"""Small splits on disk, written by hand in the layout of a split from random numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scapo import store
from scapo.categories import CATEGORIES
from scapo.store.manifest import Instance, Manifest, Shard, shards_digest
from tests.helpers.strategies import rigid_motions, rotations, unit_vectors

POINTS = 8


def sample_arrays(category: str, count: int, seed: int, instances: int = 3) -> store.Arrays:
    """`count` random samples: valid values without meaning."""
    parts, joints = len(CATEGORIES[category].parts), len(CATEGORIES[category].joints)
    rng = np.random.default_rng(seed)
    part = rng.integers(0, parts, (count, POINTS))
    part[:, -1] = 255
    return {
        "points": rng.normal(size=(count, POINTS, 3)).astype(np.float32),
        "part": part.astype(np.uint8),
        "camera_T_part": rigid_motions(seed, count, parts).numpy().astype(np.float32),
        "joint_pivot": rng.normal(size=(count, joints, 3)).astype(np.float32),
        "joint_axis": unit_vectors(seed, count, joints).numpy().astype(np.float32),
        "joint_state": rng.uniform(0, 1, (count, joints)).astype(np.float32),
        "visible": rng.uniform(0, 1, (count, parts)).astype(np.float32),
        "camera": np.tile(np.array([300, 300, 128, 128, 256, 256], np.float32), (count, 1)),
        "instance": rng.integers(0, instances, count).astype(np.int32),
    }


def instance(number: int, joints: int) -> Instance:
    """An instance with a similarity of its own."""
    matrix = np.eye(4)
    matrix[:3, :3] = 0.1 * (number + 1) * rotations(number).numpy()
    matrix[:3, 3] = rotations(number + 1)[0].numpy()
    return Instance(
        id=f"object-{number}",
        source=f"made/object-{number}",
        sha256=f"{number:064x}",
        object_T_asset=tuple(tuple(row) for row in matrix.tolist()),
        rest={f"hinge{j}": 0.0 for j in range(joints)},
        joint_names=tuple(f"hinge{j}" for j in range(joints)),
        sign=(1.0,) * joints,
    )


def write_split(
    folder: Path,
    category: str = "laptop",
    split: str = "train",
    *,
    counts: Sequence[int] = (3, 1, 4),
    seed: int = 0,
    change: Mapping[str, np.ndarray] | None = None,
    **fields: Any,
) -> Path:
    """Write shards of `counts` samples and their manifest into `folder`.

    Args:
        folder: Of the split itself.
        category: One of the nine.
        split: Name of the split.
        counts: Samples of each shard.
        seed: Of the numbers.
        change: Tensors of the first shard to put in place of its own.
        fields: Of the manifest, to put in place of its own.
    """
    known = CATEGORIES[category]
    shards: list[Shard] = []
    for number, count in enumerate(counts):
        first = sum(counts[:number])
        arrays = sample_arrays(category, count, seed + number)
        arrays = {**arrays, **(change or {})} if number == 0 else arrays
        header = {"format": store.SAMPLES, "category": category, "split": split, "first": first}
        file = f"{number:05d}.safetensors"
        sha256 = store.write(folder / file, arrays, header)
        shards.append(Shard(file=file, first=first, count=count, sha256=sha256))
    manifest = {
        "category": category,
        "split": split,
        "count": sum(counts),
        "points": POINTS,
        "parts": known.parts,
        "joints": known.joints,
        "options": {"noise": "none"},
        "seed": seed,
        "instances": tuple(instance(i, len(known.joints)) for i in range(3)),
        "shards": tuple(shards),
        "versions": {"scapo": "0.1.0"},
        "plan_digest": "0" * 64,
        "digest": shards_digest(tuple(shards)),
        "statistics": {"redrawn": 0.25},
    }
    text = Manifest(**{**manifest, **fields}).to_json()
    store.write_bytes(folder / "manifest.json", text.encode())
    return folder


def edit_manifest(folder: Path, **fields: Any) -> None:
    """Change fields of the JSON, whatever becomes of it; ... removes one."""
    path = folder / "manifest.json"
    data = {**json.loads(path.read_text()), **fields}
    kept = {name: value for name, value in data.items() if value is not ...}
    path.write_text(json.dumps(kept))


def shuffled(count: int, seed: int = 0) -> list[int]:
    """A permutation of the sample numbers."""
    return np.random.default_rng(seed).permutation(count).tolist()
