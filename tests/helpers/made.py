# SPDX-License-Identifier: MIT
"""Small splits and predictions made by hand: boxes that turn or slide, in the store's layout.

Geometrically consistent: a labelled point mapped by the inverse of its `camera_T_part` lies on
its part's box, and a child's pose is the base's followed by the joint motion.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch

from scapo import categories
from scapo.geometry import rigid as geometry
from scapo.store import SAMPLES, Split, canonical_json, sha256_bytes, write, write_bytes
from scapo.store.manifest import Instance, Manifest, Shard, shards_digest
from scapo.store.predictions import Header, write_predictions

Arrays = dict[str, np.ndarray]


def rotations(generator: np.random.Generator, count: int) -> np.ndarray:
    quaternion = torch.from_numpy(generator.normal(size=(count, 4)))
    unit = torch.nn.functional.normalize(quaternion, dim=-1)
    return roma.unitquat_to_rotmat(unit).numpy()


def sample_arrays(
    name: str, count: int, points: int, *, instances: int = 3, seed: int = 0, background: int = 0
) -> Arrays:
    """The tensors of a shard for `count` samples; the last `background` points are foreign."""
    made = categories.category(name)
    generator = np.random.default_rng(seed)
    parts = len(made.parts)
    instance = np.arange(count) % instances
    sizes = generator.uniform(0.1, 0.3, size=(instances, parts, 3))
    centres = generator.uniform(-0.2, 0.2, size=(instances, parts, 3))
    pivots = generator.uniform(-0.2, 0.2, size=(instances, parts - 1, 3))
    axes = generator.normal(size=(instances, parts - 1, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    upper = np.array([joint.upper for joint in made.joints])
    state = generator.uniform(0.15, 0.95, size=(count, parts - 1)) * upper
    base = np.tile(np.eye(4), (count, 1, 1))
    base[:, :3, :3] = rotations(generator, count)
    base[:, :3, 3] = generator.uniform([-0.1, -0.1, 0.6], [0.1, 0.1, 1.2], size=(count, 3))
    poses = [base]
    for joint, spec in enumerate(made.joints):
        motion = geometry.joint_motion(
            torch.from_numpy(pivots[instance, joint]),
            torch.from_numpy(axes[instance, joint]),
            torch.from_numpy(state[:, joint]),
            spec.kind,
        ).numpy()
        poses.append(base @ motion)
    camera_T_part = np.stack(poses, 1)
    part = generator.integers(0, parts, size=(count, points))
    part[:, :parts] = np.arange(parts)  # every part is seen
    own = generator.uniform(-0.5, 0.5, size=(count, points, 3))
    own = own * sizes[instance[:, None], part] + centres[instance[:, None], part]
    pose = camera_T_part[np.arange(count)[:, None], part]
    cloud = np.einsum("bnij,bnj->bni", pose[..., :3, :3], own) + pose[..., :3, 3]
    if background:
        cloud[:, -background:] += generator.normal(scale=0.2, size=(count, background, 3))
        part[:, -background:] = 255
    turn, shift = base[:, None, :3, :3], base[:, None, :3, 3]
    pivot = (turn @ pivots[instance][..., None])[..., 0] + shift
    axis = (turn @ axes[instance][..., None])[..., 0]
    float32 = {
        "points": cloud,
        "camera_T_part": camera_T_part,
        "joint_pivot": pivot,
        "joint_axis": axis,
        "joint_state": state,
        "visible": generator.uniform(0.2, 0.8, size=(count, parts)),
        "camera": np.tile([222.0, 222.0, 128.0, 128.0, 256.0, 256.0], (count, 1)),
    }
    return {
        **{key: value.astype(np.float32) for key, value in float32.items()},
        "part": part.astype(np.uint8),
        "instance": instance.astype(np.int32),
    }


def write_split(
    folder: Path,
    name: str,
    split: str,
    arrays: Arrays,
    *,
    shard_size: int = 1000,
    options: dict[str, Any] | None = None,
) -> Split:
    """Write `folder/name/split` as the data programs do."""
    made = categories.category(name)
    target = folder / name / split
    count, shards = len(arrays["part"]), []
    for number, first in enumerate(range(0, count, shard_size)):
        piece = {key: value[first : first + shard_size] for key, value in arrays.items()}
        header = {"format": SAMPLES, "category": name, "split": split, "first": first}
        file = f"{number:05d}.safetensors"
        sha256 = write(target / file, piece, header)
        shards.append(Shard(file=file, first=first, count=len(piece["part"]), sha256=sha256))
    options = options or {}
    manifest = Manifest(
        category=name,
        split=split,
        count=count,
        points=arrays["points"].shape[1],
        parts=made.parts,
        joints=made.joints,
        options=options,
        seed=1,
        instances=tuple(_instance(i, made) for i in range(int(arrays["instance"].max()) + 1)),
        shards=tuple(shards),
        versions={},
        plan_digest=sha256_bytes(canonical_json(options).encode()),
        digest=shards_digest(tuple(shards)),
        statistics={},
    )
    write_bytes(target / "manifest.json", manifest.to_json().encode())
    return Split(target)


def _instance(index: int, made: categories.Category) -> Instance:
    names = tuple(f"joint{j}" for j in range(len(made.joints)))
    return Instance(
        id=f"made-{index}",
        source=f"made/{index}",
        sha256="0" * 64,
        object_T_asset=tuple(tuple(row) for row in np.eye(4).tolist()),
        rest=dict.fromkeys(names, 0.0),
        joint_names=names,
        sign=(1.0,) * len(names),
    )


def make_data(
    folder: Path,
    name: str = "laptop",
    *,
    count: int = 12,
    train: int = 10,
    points: int = 64,
    background: int = 0,
    options: dict[str, Any] | None = None,
) -> Split:
    """A train and a test split of a category; returns the test split."""
    for split, size, seed in (("train", train, 1), ("test", count, 2)):
        arrays = sample_arrays(name, size, points, seed=seed, background=background)
        made = write_split(folder, name, split, arrays, shard_size=5, options=options)
    return made


def truth_as_prediction(split: Split, *, weights: bool = False) -> Arrays:
    """The truth in the tensors of a predictions file."""
    names = ("camera_T_part", "joint_pivot", "joint_axis", "joint_state")
    arrays = split.arrays("part", *names)
    part = arrays.pop("part")
    if not weights:
        return {"part": part, **arrays}
    parts = arrays["camera_T_part"].shape[1]
    one_hot = np.eye(parts, dtype=np.float32)[np.where(part == 255, 0, part)]
    return {"part_weight": one_hot, **arrays}


def header_of(made_on: Split, /, **changes: Any) -> Header:
    """A valid header for predictions on `split`."""
    fields: dict[str, Any] = {
        "method": "made",
        "variant": "",
        "category": made_on.manifest.category,
        "split": made_on.manifest.split,
        "seed": 1,
        "data_digest": made_on.manifest.digest,
        "supervision": (),
    }
    return Header(**(fields | changes))


def write_truth(path: Path, split: Split, **changes: Any) -> Path:
    """Predictions equal to the truth."""
    write_predictions(path, header_of(split, **changes), truth_as_prediction(split))
    return path


def unambiguous(arrays: Arrays) -> Arrays:
    """The same samples, said to look like no turn of themselves."""
    pose, state = arrays["camera_T_part"], arrays["joint_state"]
    count, parts = pose.shape[:2]
    alike = np.zeros((count, 24), np.uint8)
    alike[:, 0] = 1
    return arrays | {
        "alike": alike,
        "alike_base": np.repeat(pose[:, :1], 24, 1),
        "alike_state": np.repeat(state[:, None], 24, 1),
        "alike_part": np.tile(np.arange(parts, dtype=np.uint8), (count, 24, 1)),
    }


def give_traits(split: Split, traits: list[str]) -> Split:
    """The same split, each object with its trait."""
    path = split.folder / "manifest.json"
    manifest = json.loads(path.read_text())
    for instance, trait in zip(manifest["instances"], traits, strict=True):
        instance["trait"] = trait
    path.write_text(json.dumps(manifest))
    return Split(split.folder)
