# SPDX-License-Identifier: MIT
"""Kinds of damage to a predictions file: name -> function of the split and its true tensors."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from safetensors.numpy import save

from scapo.store import canonical_json
from tests.helpers import made


def header_json(made_on, /, **changes):
    record = made.header_of(made_on).record() | changes
    return {key: value for key, value in record.items() if value is not ...}


def file_bytes(arrays, header, **entries):
    text = header if isinstance(header, str) else canonical_json(header)
    return save({k: np.ascontiguousarray(v) for k, v in arrays.items()},
                metadata={"scapo": text, **entries})  # fmt: skip


def changed(name, edit):
    """Damage of one tensor."""

    def damage(split, arrays):
        arrays = {key: value.copy() for key, value in arrays.items()}
        result = edit(arrays[name])
        arrays[name] = arrays[name] if result is None else result
        return file_bytes(arrays, header_json(split))

    return damage


def with_header(**changes):
    return lambda split, arrays: file_bytes(arrays, header_json(split, **changes))


def set_at(index, value: Any):
    def edit(array):
        array[index] = value

    return edit


def dropped(*names):
    def damage(split, arrays):
        kept = {key: value for key, value in arrays.items() if key not in names}
        return file_bytes(kept, header_json(split))

    return damage


def added(**extra):
    return lambda split, arrays: file_bytes(
        arrays | {k: make(arrays) for k, make in extra.items()}, header_json(split)
    )


def weights(edit):
    """The file with weights instead of labels, damaged."""

    def damage(split, arrays):
        arrays = made.truth_as_prediction(split, weights=True)
        return file_bytes(arrays | {"part_weight": edit(arrays["part_weight"])}, header_json(split))

    return damage


def unanswered(split, arrays):
    """The right tensors with nothing in them; a confidence is no answer."""
    empty = {
        name: np.full_like(array, 255 if name == "part" else np.nan)
        for name, array in arrays.items()
    }
    empty["confidence_pose"] = np.ones(len(arrays["part"]), np.float32)
    return file_bytes(empty, header_json(split))


def raw(edit):
    return lambda split, arrays: edit(file_bytes(arrays, header_json(split)))


def reheaded(edit):
    """The safetensors header itself, damaged."""

    def damage(split, arrays):
        data = file_bytes(arrays, header_json(split))
        size = struct.unpack("<Q", data[:8])[0]
        text = edit(json.loads(data[8 : 8 + size]))
        return struct.pack("<Q", len(text)) + text + data[8 + size :]

    return damage


def offsets_past_the_end(header):
    header["joint_axis"]["data_offsets"][1] += 10**9
    return json.dumps(header).encode()


def bfloat(header):
    header["joint_state"]["dtype"] = "BF16"
    header["joint_state"]["shape"][0] *= 2
    return json.dumps(header).encode()


def scaled(factor):
    return lambda array: array * np.float32(factor)


FRAME = {"split": "train", "data_digest": "d" * 64, "samples": 30}
DAMAGE = {
    "empty file": lambda split, arrays: b"",
    "not safetensors": lambda split, arrays: b"method,variant,seed\n" * 9,
    "a pickle": lambda split, arrays: b"\x80\x04\x95" + b"c__builtin__\neval\n" * 9,
    "a zip": lambda split, arrays: b"PK\x03\x04" + bytes(200),
    "truncated in the tensors": raw(lambda data: data[:-100]),
    "truncated in the header": raw(lambda data: data[:40]),
    "bytes appended": raw(lambda data: data + b"\0" * 16),
    "header length huge": raw(lambda data: struct.pack("<Q", 2**60) + data[8:]),
    "header length zero": raw(lambda data: struct.pack("<Q", 0) + data[8:]),
    "offsets past the end": reheaded(offsets_past_the_end),
    "bfloat16": reheaded(bfloat),
    "no metadata": lambda split, arrays: save(arrays),
    "a second metadata entry": lambda split, arrays: file_bytes(
        arrays, header_json(split), framework="pt"
    ),
    "metadata no JSON": lambda split, arrays: file_bytes(arrays, "{"),
    "metadata a list": lambda split, arrays: file_bytes(arrays, "[]"),
    "metadata deep": lambda split, arrays: file_bytes(arrays, "[" * 100_000),
    "another format": with_header(format="scapo-samples/1"),
    "a later format": with_header(format="scapo-predictions/2"),
    "no format": with_header(format=...),
    "no method": with_header(method=...),
    "empty method": with_header(method=""),
    "method with a line break": with_header(method="a\nb"),
    "method a number": with_header(method=3),
    "no variant": with_header(variant=...),
    "no category": with_header(category=...),
    "unknown category": with_header(category="teapot"),
    "another category": with_header(category="laptop"),
    "no split": with_header(split=...),
    "another split": with_header(split="train"),
    "no seed": with_header(seed=...),
    "seed a text": with_header(seed="1"),
    "seed a fraction": with_header(seed=1.5),
    "seed a truth value": with_header(seed=True),
    "seed too large": with_header(seed=2**70),
    "no digest": with_header(data_digest=...),
    "foreign digest": with_header(data_digest="0" * 64),
    "no supervision": with_header(supervision=...),
    "unknown supervision": with_header(supervision=["pose", "masks"]),
    "supervision a text": with_header(supervision="pose"),
    "supervision nested": with_header(supervision=[["pose"]]),
    "budget a text": with_header(budget="cheap"),
    "camera a text": with_header(camera="yes"),
    "camera a number": with_header(camera=1),
    "an object frame in text": with_header(object_frame="yes"),
    "an object frame of no data": with_header(object_frame={"split": "train", "samples": 3}),
    "an object frame of two parts": with_header(object_frame=FRAME | {"order": [1, 0]}),
    "an object frame with a part twice": with_header(object_frame=FRAME | {"order": [0, 1, 1]}),
    "no tensors": lambda split, arrays: file_bytes({}, header_json(split)),
    "no segmentation": dropped("part"),
    "both segmentations": added(
        part_weight=lambda a: np.full((*a["part"].shape, 3), 1 / 3, np.float32)
    ),
    "an unknown tensor": added(camera_T_parts=lambda a: a["camera_T_part"]),
    "an unknown record": added(record_R_selected=lambda a: a["camera_T_part"]),
    "labels as int64": changed("part", lambda a: a.astype(np.int64)),
    "labels as floats": changed("part", lambda a: a.astype(np.float32)),
    "a label out of range": changed("part", set_at((3, 5), 3)),
    "labels one short": changed("part", lambda a: a[:, :-1]),
    "one sample short": changed("part", lambda a: a[:-1]),
    "one sample more": changed("camera_T_part", lambda a: np.concatenate([a, a[:1]])),
    "no answer at all": unanswered,
    "weights as float64": weights(lambda a: a.astype(np.float64)),
    "weights transposed": weights(lambda a: np.swapaxes(a, 1, 2)),
    "weights of two parts": weights(lambda a: a[..., :2]),
    "negative weights": weights(lambda a: a * 3 - 2 / 3),
    "weights that sum to two": weights(lambda a: 2 * a),
    "weights that sum to 0.9": weights(scaled(0.9)),
    "logits": weights(lambda a: 10 * a - 5),
    "a NaN among weights": weights(lambda a: np.where(np.arange(3) == 1, np.nan, a)),
    "an infinite weight": weights(lambda a: np.where(a > 0.5, np.inf, a)),
    "poses as float16": changed("camera_T_part", lambda a: a.astype(np.float16)),
    "poses 3x4": changed("camera_T_part", lambda a: a[:, :, :3]),
    "poses by part first": changed("camera_T_part", lambda a: np.swapaxes(a, 0, 1)),
    "poses of two parts": changed("camera_T_part", lambda a: a[:, :2]),
    "poses transposed": changed("camera_T_part", lambda a: np.swapaxes(a, -1, -2)),
    "scaled rotations": changed("camera_T_part", lambda a: a * np.float32(1.01)),
    "a reflection": changed("camera_T_part", set_at((2, 1, slice(None), 0), [-1, 0, 0, 0])),
    "a mirrored frame": changed(
        "camera_T_part", lambda a: a @ np.diag(np.array([1, 1, -1, 1], np.float32))
    ),
    "a zero rotation": changed("camera_T_part", set_at((4, 0, slice(3), slice(3)), 0)),
    "a wrong last row": changed("camera_T_part", set_at((4, 0, 3), [0, 0, 0, 2])),
    "an infinite translation": changed("camera_T_part", set_at((1, 2, 0, 3), -np.inf)),
    "pivots as float64": changed("joint_pivot", lambda a: a.astype(np.float64)),
    "one pivot per sample": changed("joint_pivot", lambda a: a[:, 0]),
    "an infinite pivot": changed("joint_pivot", set_at((0, 0, 1), np.inf)),
    "axes of three joints": changed("joint_axis", lambda a: np.concatenate([a, a[:, :1]], 1)),
    "axes as integers": changed("joint_axis", lambda a: a.astype(np.int32)),
    "states with a last axis": changed("joint_state", lambda a: a[..., None]),
    "an infinite state": changed("joint_state", set_at((2, 0), np.inf)),
    "an empty canonical shape": added(
        canonical_points=lambda a: np.zeros((len(a["part"]), 0, 3), np.float32)
    ),
    "a canonical shape of too many points": added(
        canonical_points=lambda a: np.zeros((len(a["part"]), 1 << 17, 3), np.float32)
    ),
    "a flat canonical shape": added(
        canonical_points=lambda a: np.zeros((len(a["part"]), 30), np.float32)
    ),
    "an infinite confidence": added(
        confidence_pose=lambda a: np.full(len(a["part"]), np.inf, np.float32)
    ),
    "a confidence of other samples": added(confidence_pose=lambda a: np.ones(3, np.float32)),
}  # fmt: skip
