# SPDX-License-Identifier: MIT
"""OP-Align's maps between the aligned input, the canonical shape and the input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bench.matching import project_rotations

_BLOCKS = {2: ((0, 0, 0), (0, 1, 1)), 3: ((0, 0, 0), (0, 1, 1), (1, 0, 0), (1, 1, 2))}
"""(joint, which of its two states, part) in the published order, by number of parts."""

_CLAMP = 1e-4
"""The published direction rotation clamps the cosine this far from +-1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Chain:
    """Which reading of the maps."""

    revolute: bool
    corrected: bool
    """Translations rotated and the third part kept; otherwise as released. The clamp of
    `dir_to_dir_rotation` stays in both, as in the corrected evaluator."""


def exp_so3(rotvec: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3 3"]:
    """Rotation matrix of an axis times angle, by series for tiny angles."""
    rotvec = np.asarray(rotvec, np.float64)
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    skew = _skew(rotvec)
    tiny = angle < 1e-4
    safe = np.where(tiny, 1.0, angle)
    first = np.where(tiny, 1 - angle**2 / 6, np.sin(safe) / safe)
    second = np.where(tiny, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    return np.eye(3) + first * skew + second * (skew @ skew)


def _skew(v: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3 3"]:
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    rows = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    return rows.reshape(*v.shape[:-1], 3, 3)


def dir_to_dir_rotation(
    source: Float[np.ndarray, "*B 3"], target: Float[np.ndarray, "*B 3"]
) -> Float[np.ndarray, "*B 3 3"]:
    """Smallest rotation taking the direction of `source` to that of `target`, as published.

    The cosine keeps 1e-4 from +-1, so it never turns by less than 0.81 degrees; equal and opposite
    directions have no axis: NaN. `scapo.geometry.rigid.rotation_between` is the exact one.
    """
    a = source / np.linalg.norm(source, axis=-1, keepdims=True)
    b = target / np.linalg.norm(target, axis=-1, keepdims=True)
    cross = np.cross(a, b)
    sine = np.linalg.norm(cross, axis=-1, keepdims=True)
    cosine = (a * b).sum(-1, keepdims=True)
    axis = np.divide(cross, sine, out=np.full(cross.shape, np.nan), where=sine > 0)
    return exp_so3(axis * np.arccos(np.clip(cosine, -1 + _CLAMP, 1 - _CLAMP)))


def _block_maps(
    record: Mapping[str, Any], chain: Chain, *, to_canonical: bool
) -> list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Per block (part, rotation (B,3,3), from-pivot, to-pivot): y -> R (y - from) + to."""
    names = ("S", "I") if to_canonical else ("I", "S")
    keys = ("joint", "drct", "angl")
    source, target = ({k: np.asarray(record[f"{n}_{k}"], np.float64) for k in keys} for n in names)
    turn = dir_to_dir_rotation(source["drct"], target["drct"])
    joints = source["joint"].shape[1]
    blocks = []
    for joint, side, part in _BLOCKS[joints + 1]:
        change = (target["angl"] - source["angl"])[:, joint, side, None]
        step = target["drct"][:, joint] * change
        to_pivot = target["joint"][:, joint]
        rotation = turn[:, joint]
        if chain.revolute:
            rotation = exp_so3(step) @ rotation
        else:
            to_pivot = to_pivot + step
        blocks.append((part, rotation, source["joint"][:, joint], to_pivot))
    return blocks


def _through_blocks(
    blocks: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]],
    rotation: Float[np.ndarray, "B P 3 3"],
    shift: Float[np.ndarray, "B P 3"],
    chain: Chain,
) -> tuple[Float[np.ndarray, "B P 3 3"], Float[np.ndarray, "B P 3"]]:
    """Every part through its joint; the base of three parts is the average of both joints.

    As released, the third of three parts is then the base seen through joint 1 (docs/protocol.md).
    """
    turns = [turn @ rotation[:, part] for part, turn, _, _ in blocks]
    moves = [
        (turn @ (shift[:, part] - start)[..., None])[..., 0] + end
        for part, turn, start, end in blocks
    ]
    if len(blocks) == 4:
        turns[0] = project_rotations(turns[0] + turns[2])
        moves[0] = 0.5 * (moves[0] + moves[2])
        kept = (0, 1, 3) if chain.corrected else (0, 1, 2)
        turns, moves = [turns[i] for i in kept], [moves[i] for i in kept]
    return np.stack(turns, 1), np.stack(moves, 1)


def straight_chain(
    record: Mapping[str, Any], pose: Float[np.ndarray, "B P 4 4"], chain: Chain
) -> Float[np.ndarray, "B P 4 4"]:
    """True part poses in the input frame brought to canonical space."""
    turn = np.swapaxes(np.asarray(record["R_select"], np.float64), -1, -2)[:, None]
    offset = np.asarray(record["T_select"], np.float64)[:, None]
    shift = pose[..., :3, 3]
    if chain.corrected:
        shift = (turn @ shift[..., None])[..., 0]
    blocks = _block_maps(record, chain, to_canonical=True)
    out = np.zeros_like(pose)
    out[..., :3, :3], out[..., :3, 3] = _through_blocks(
        blocks, turn @ pose[..., :3, :3], shift - offset, chain
    )
    out[..., 3, 3] = 1
    return out


def inverse_chain(
    record: Mapping[str, Any], canon: tuple[np.ndarray, np.ndarray], chain: Chain
) -> tuple[Float[np.ndarray, "B P 3 3"], Float[np.ndarray, "B P 3"]]:
    """The canonical part poses (P,3,3), (P,3) brought to the input frame of every sample."""
    turn = np.asarray(record["R_select"], np.float64)[:, None]
    offset = np.asarray(record["T_select"], np.float64)[:, None]
    count = len(turn)
    rotation = np.broadcast_to(canon[0], (count, *canon[0].shape))
    shift = np.broadcast_to(canon[1], (count, *canon[1].shape))
    blocks = _block_maps(record, chain, to_canonical=False)
    rotation, shift = _through_blocks(blocks, rotation, shift, chain)
    shift = shift + offset
    if chain.corrected:
        shift = (turn @ shift[..., None])[..., 0]
    return turn @ rotation, shift
