# SPDX-License-Identifier: MIT
"""Predictions files: the header, the tensors, and the refusal of what is not one.

One safetensors file, written by any program (docs/bring-your-own-method.md). Every complaint is
one line: `file: tensor: expected, found`. A sample whose whole row of a tensor is NaN has no answer
there, nor has a part or joint with a NaN among its own numbers: scores are empty and counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Num
from safetensors import SafetensorError, safe_open

from scapo.alignment import ObjectFrame
from scapo.categories import Category
from scapo.geometry.matrices import rotation_error
from scapo.store.definitions import defined, definition, foreign
from scapo.store.files import PREDICTIONS, read_header, write
from scapo.store.json_records import from_json
from scapo.store.manifest import Manifest
from scapo.store.samples import UNLABELLED
from scapo.store.schema import StoreError
from scapo.store.split import Split, open_split
from scapo.types import Supervision

RECORD: dict[str, tuple[int | None, ...]] = {
    "R_select": (3, 3),
    "T_select": (3,),
    "S_joint": (None, 3),
    "S_drct": (None, 3),
    "S_angl": (None, 2),
    "I_joint": (None, 3),
    "I_drct": (None, 3),
    "I_angl": (None, 2),
}
"""The network-side quantities of OP-Align: rotation and translation chosen for the input, and
pivots, directions and pairs of states on the aligned input (S) and the canonical shape (I).
Shape of a sample: None for the number of joints."""
LONGEST_NAME = 200
"""Characters of a name in the header."""
DIGEST_KEYS = ("data_digest", "digest", "data")
"""The header field that names the data; the first is ours, the others are read too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """What made a predictions file."""

    method: str
    variant: str
    category: str
    split: str
    seed: int
    data_digest: str
    """`digest` of the manifest of the split that was predicted."""
    supervision: tuple[Supervision, ...]
    """Labels that training used."""
    camera: bool | None = None
    """Whether training or prediction uses where the camera stands; None: not said."""
    budget: dict[str, Any] = field(default_factory=dict)
    """Anything about cost: device, batch, seconds_per_cloud, training_seconds, parameters."""
    run: dict[str, Any] = field(default_factory=dict)
    """The training behind it: commit, config, machine, data digest of its split."""
    definition: Category | None = None
    """Of a category that the package has not."""
    object_frame: ObjectFrame | None = None
    """None: where `supervision` has no poses, frames, order of parts and states are the method's
    own."""

    def record(self) -> dict[str, Any]:
        """As stored in the file, without what is not said."""
        own = asdict(replace(self, definition=None))
        said = {name: value for name, value in own.items() if value is not None}
        kind = {} if self.definition is None else definition(self.definition)
        return {**said, "format": PREDICTIONS, "supervision": sorted(self.supervision), **kind}


def write_predictions(path: Path, header: Header, arrays: Mapping[str, np.ndarray]) -> str:
    """Write a predictions file atomically; returns its SHA-256."""
    return write(path, arrays, header.record())


def read_prediction_header(path: Path) -> Header:
    """The header, every field checked.

    Raises:
        StoreError: Not a predictions file, a second metadata entry, a missing or wrong field.
    """
    if not path.exists():
        raise StoreError(
            f"{path}: expected a file, found none; `scapo-bench predict RUN --out FILE` writes one"
        )
    try:
        record = read_header(path, PREDICTIONS)
        with safe_open(path, "numpy") as file:
            entries = sorted(file.metadata() or {})
    except (SafetensorError, OSError, RecursionError, UnicodeError) as error:
        raise StoreError(
            f"{path}: expected a safetensors file with a header, found {error}"
        ) from error
    if entries != ["scapo"]:
        raise StoreError(f"{path}: expected the one metadata entry 'scapo', found {entries}")
    where = f"{path}: header"
    digest = next((record[key] for key in DIGEST_KEYS if key in record), None)
    fields = {**record, "data_digest": digest, "definition": None}
    header = from_json(Header, fields, where, link=" field ")
    _check_fields(where, header)
    known = defined(record, header.category, where)
    return replace(
        header,
        supervision=tuple(sorted(set(header.supervision))),
        definition=None if known is None else foreign(known),
    )


def _check_fields(where: str, header: Header) -> None:
    """Beyond their types: texts that can be shown, a seed and an order that can be."""
    for name in ("method", "variant", "category", "split", "data_digest"):
        text = getattr(header, name)
        if not text.isprintable() or not (name == "variant" or text) or len(text) > LONGEST_NAME:
            raise StoreError(
                f"{where} field {name}: expected text of at most {LONGEST_NAME} characters, "
                f"found {repr(text)[:LONGEST_NAME]}"
            )
    if abs(header.seed) >= 2**63:
        raise StoreError(f"{where} field seed: expected one of 64 bits, found another")
    order = () if header.object_frame is None else header.object_frame.order
    if sorted(order) != list(range(len(order))):
        raise StoreError(f"{where} field object_frame: expected every part once, found {order}")


def check_belongs(path: Path, header: Header, manifest: Manifest) -> None:
    """Refuse predictions of another category, split or data set.

    Raises:
        StoreError: Naming the field.
    """
    expected = {
        "category": manifest.category,
        "split": manifest.split,
        "data_digest": manifest.digest,
    }
    for name, want in expected.items():
        have = getattr(header, name)
        if have != want:
            raise StoreError(
                f"{path}: header field {name!r}: expected {want!r} as in the data, found {have!r}"
            )


def find_data(folder: Path, header: Header) -> Split:
    """The split that a header names, its bytes verified.

    Where several data sets below `folder` have that category and split (the benchmark's `clean`
    and `sensor` both have laptops), the digest decides.

    Raises:
        StoreError: Not found, not unique, or changed shards.
    """
    pattern = f"*/{header.category}/{header.split}/manifest.json"
    candidates = [Split(path.parent) for path in sorted(folder.glob(pattern))]
    fitting = [split for split in candidates if split.manifest.digest == header.data_digest]
    if len(candidates) > 1 and len(fitting) == 1:
        found = fitting[0]
    else:
        found = open_split(folder, header.category, header.split)
    found.verify()
    return found


class Predictions:
    """An open predictions file, read and validated in blocks of samples."""

    def __init__(self, path: Path, split: Split) -> None:
        """Validate header, names, dtypes and shapes against the data.

        Raises:
            StoreError: One line naming what was expected and found.
        """
        self.path = path
        self.header = read_prediction_header(path)
        check_belongs(path, self.header, split.manifest)
        self.unanswered: dict[str, int] = {}
        """Samples without an answer, or without one of a part or joint, so far, by tensor."""
        self._answered = False
        self._count = split.manifest.count
        self._parts = len(split.manifest.parts)
        frame = self.header.object_frame
        if frame is not None and len(frame.order) not in (0, self._parts):
            raise StoreError(
                f"{path}: header field 'object_frame': order: expected that of {self._parts} "
                f"parts, found {frame.order}"
            )
        self._file = safe_open(path, "numpy")
        self._slices = check_tensors(str(path), self._file.__enter__(), split)

    def __enter__(self) -> Predictions:
        return self

    def __exit__(self, *exc: object) -> None:
        self._slices = {}
        self._file.__exit__(*exc)

    @property
    def names(self) -> tuple[str, ...]:
        """The tensors of the file, sorted."""
        return tuple(sorted(self._slices))

    def rows(self, first: int, count: int) -> dict[str, np.ndarray]:
        """The tensors of samples first..first+count-1, checked.

        `part` comes as int16 with -1 for 255.

        Raises:
            StoreError: A value no answer can have, naming tensor and sample.
        """
        out: dict[str, np.ndarray] = {}
        for name, item in self._slices.items():
            try:
                array = item[first : first + count]
            except SafetensorError as error:
                raise StoreError(
                    f"{self.path}: tensor {name!r}: expected readable data, found {error}"
                ) from error
            where = f"{self.path}: tensor {name!r}"
            out[name], missing = check_rows(where, name, array, first, self._parts)
            if name.startswith(CONFIDENCE):  # no answer
                continue
            self.unanswered[name] = self.unanswered.get(name, 0) + missing
            known = out[name] >= 0 if name == "part" else ~np.isnan(out[name])
            self._answered |= bool(known.any())
        return out

    def finish(self) -> None:
        """After the last block: refuse a file that answers nothing at all.

        Raises:
            StoreError: No tensor has an answer for any sample; a confidence is none.
        """
        if self._count and not self._answered:
            raise StoreError(
                f"{self.path}: expected an answer for at least one of {self._count} samples, "
                f"found none in {', '.join(self.names)}"
            )


_HALF_OR_FLOAT = ("F16", "F32")
_NUMBER = ("F16", "F32", "F64")

CONFIDENCE = "confidence_"
SLOTTED = ("camera_T_part", "joint_pivot", "joint_axis", "joint_state")
"""Tensors of parts or joints, each of which may lack its answer alone."""
MAX_VALUES = 1 << 18
"""Of a tensor's row: a sparse file may say that it holds terabytes."""
ROTATION_TOLERANCE = 1e-3
"""Largest entry of R R^T - I and of the last row minus 0 0 0 1."""
WEIGHT_TOLERANCE = {np.dtype(np.float16): 4e-3, np.dtype(np.float32): 1e-3}
"""Of the sum of a point's weights; half precision keeps 11 bits of each."""


def check_tensors(where: str, file: Any, split: Split) -> dict[str, Any]:  # noqa: ANN401
    """The slices of an open safetensors file after checking names, dtypes and shapes.

    Raises:
        StoreError: A tensor is missing, unknown, of another type or shape.
    """
    manifest, count = split.manifest, split.manifest.count
    shapes, joints = split.shapes(count), len(manifest.joints)
    layout: dict[str, tuple[tuple[str, ...], tuple[int | None, ...]]] = {
        "part": (("U8",), shapes["part"]),
        "part_weight": (_HALF_OR_FLOAT, (*shapes["part"], len(manifest.parts))),
        **{name: (("F32",), shapes[name]) for name in SLOTTED},
        "canonical_points": (("F32",), (count, None, 3)),
        **{
            f"record_{name}": (_NUMBER, (count, *(joints if d is None else d for d in dims)))
            for name, dims in RECORD.items()
        },
        "record_expand": (_NUMBER, (count,)),
        "record_center": (_NUMBER, (count, 3)),
    }
    slices: dict[str, Any] = {}
    for name in file.keys():  # noqa: SIM118 - an open file, not a dict
        item = file.get_slice(name)
        expected = layout.get(name)
        if expected is None and name.startswith(CONFIDENCE):
            expected = (_HALF_OR_FLOAT, (count, *item.get_shape()[1:]))
        if expected is None:
            raise StoreError(
                f"{where}: expected tensors {', '.join(layout)} or confidence_*, found {name!r}"
            )
        _check_tensor(f"{where}: tensor {name!r}", item, *expected)
        slices[name] = item
    if ("part" in slices) == ("part_weight" in slices):
        found = "both" if "part" in slices else f"{', '.join(sorted(slices)) or 'no tensor'}"
        raise StoreError(
            f"{where}: expected one of the tensors 'part' and 'part_weight', found {found}"
        )
    return slices


def _check_tensor(
    where: str,
    item: Any,  # noqa: ANN401
    dtypes: tuple[str, ...],
    shape: tuple[int | None, ...],
) -> None:
    found, dtype = tuple(item.get_shape()), item.get_dtype()
    if dtype not in dtypes:
        raise StoreError(f"{where}: expected dtype {' or '.join(dtypes)}, found {dtype}")
    fits = len(found) == len(shape) and all(
        want in (None, have) for want, have in zip(shape, found, strict=True)
    )
    if not fits or 0 in found[1:]:
        wanted = tuple("*" if want is None else want for want in shape)
        raise StoreError(f"{where}: expected shape {wanted}, found {found}")
    if math.prod(found[1:]) > MAX_VALUES:
        raise StoreError(f"{where}: expected at most {MAX_VALUES} values a sample, found {found}")


def check_rows(
    where: str, name: str, array: np.ndarray, first: int, parts: int
) -> tuple[np.ndarray, int]:
    """A block of one tensor after checking its values, and how many samples lack an answer.

    A part or joint with a NaN among its numbers comes back as NaN alone: half an answer is none.

    Args:
        where: File and tensor, for the message.
        name: Of the tensor.
        array: Rows of consecutive samples.
        first: Index of the first of them, for the message.
        parts: P.

    Raises:
        StoreError: A value that no answer can have, naming the sample.
    """
    if name == "part":
        return _check_labels(where, array, first, parts)
    alone = name in SLOTTED or (name.startswith(CONFIDENCE) and array.ndim > 1)
    slots = array.reshape(len(array), array.shape[1] if alone else 1, -1)
    infinite = np.asarray(np.isinf(slots).any((1, 2)))
    _refuse(infinite, where, first, "finite values or NaN", lambda i: "an infinite value")
    lost = np.isnan(slots)
    some = np.asarray(lost.any(2))
    half = some & ~np.asarray(lost.all(2))
    if not alone:
        _refuse(half[:, 0], where, first, "a row of NaN or none", lambda i: "some NaN")
    if half.any():
        array = np.where(some[..., None], array.dtype.type(np.nan), slots).reshape(array.shape)
    if name == "part_weight":
        _check_weights(where, array, np.flatnonzero(~some[:, 0]), first)
    if name == "camera_T_part":
        _check_poses(where, array, ~some, first)
    return array, int(np.asarray(some.any(1)).sum())


def _refuse(
    wrong: Bool[np.ndarray, " B"],
    where: str,
    first: int,
    expected: str,
    found: Callable[[int], str],
) -> None:
    if wrong.any():
        index = int(wrong.argmax())
        raise StoreError(
            f"{where}: sample {first + index}: expected {expected}, found {found(index)}"
        )


def _check_labels(
    where: str, array: Num[np.ndarray, "B N"], first: int, parts: int
) -> tuple[np.ndarray, int]:
    """255 says that the point belongs to no part; a row of nothing else is no answer."""
    none = array == UNLABELLED
    outside = (array >= parts) & ~none
    _refuse(
        outside.any(1),
        where,
        first,
        f"labels 0..{parts - 1} or {UNLABELLED}",
        lambda i: str(int(array[i][outside[i]][0])),
    )
    part = array.astype(np.int16)
    part[none] = -1
    return part, int(none.all(1).sum())


def _check_weights(where: str, array: np.ndarray, known: np.ndarray, first: int) -> None:
    weights = array.astype(np.float32, copy=False)
    tolerance = WEIGHT_TOLERANCE[array.dtype]
    wrong = np.zeros(len(array), bool)
    total = sum(weights[..., k] for k in range(weights.shape[-1]))
    lowest = weights.min(axis=(1, 2))
    wrong[known] = lowest[known] < -tolerance
    _refuse(wrong, where, first, "weights of 0 or more", lambda i: f"{lowest[i]:.4g}")
    error = np.abs(total - np.float32(1)).max(1)
    wrong[known] = error[known] > tolerance
    expected = f"weights of a point to sum to 1 within {tolerance}"
    _refuse(wrong, where, first, expected, lambda i: f"an error of {error[i]:.4g}")


def _check_poses(where: str, array: np.ndarray, known: np.ndarray, first: int) -> None:
    worst = np.zeros(known.shape)
    worst[known] = rotation_error(array[known][:, :3, :3])
    worst = worst.max(1)
    _refuse(
        worst > ROTATION_TOLERANCE,
        where,
        first,
        f"rotations with R R^T = I within {ROTATION_TOLERANCE} and det R = 1",
        lambda i: f"an error of {worst[i]:.4g}" if worst[i] != 2 else "a reflection",
    )
    last = np.zeros(known.shape)
    last[known] = np.abs(array[known][:, 3, :] - np.array([0, 0, 0, 1])).max(-1)
    last = last.max(1)
    wrong = np.asarray(last > ROTATION_TOLERANCE)
    _refuse(wrong, where, first, "a last row 0 0 0 1", lambda i: f"an error of {last[i]:.4g}")
