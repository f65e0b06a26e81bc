# SPDX-License-Identifier: MIT
"""What is written of one object: joints.json, parts.ply, and the twin's own files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bench.requests import Mode
from bench.twin.export import write_twin
from bench.twin.page import write_page
from bench.twin.record import BACKGROUND, Twin
from scapo.drawing import BACKGROUND as BACKGROUND_COLOR
from scapo.drawing import PART_COLORS
from scapo.store.folders import whole_folder

FORMAT = "scapo-joints/1"
JOINTS, PARTS, PAGE, OBJECT = "joints.json", "parts.ply", "page.html", "object"


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """How the category was chosen."""

    by: str
    """run, category or residual."""
    residuals: Mapping[str, float] = field(default_factory=dict)
    """Of each model that was asked, by category."""

    @property
    def margin(self) -> float | None:
        """By how much the next best model explains the view worse; None with fewer than two."""
        ordered = sorted(self.residuals.values())
        return ordered[1] - ordered[0] if len(ordered) > 1 else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One answer."""

    twin: Twin
    choice: Choice
    mode: Mode
    uncalibrated: str | None
    """Why there are no confidences; None where there are."""
    aligned: bool
    """Whether frames, order of parts and zeros of states are the category's."""


def joints_record(result: Result) -> dict[str, Any]:
    """The contents of joints.json (docs/infer.md)."""
    twin, choice = result.twin, result.choice
    return {
        "format": FORMAT,
        "input": twin.name,
        "frame": twin.frame,
        "units": {"length": "m", "angle": "rad"},
        "category": {
            "name": twin.category.name,
            "chosen_by": choice.by,
            "residuals": dict(choice.residuals),
            "margin": choice.margin,
        },
        "model": {**twin.model, "mode": result.mode},
        "part_frames": "object" if result.aligned else "model",
        "parts": _parts(twin),
        "joints": _joints(twin),
        "confidence": {
            "calibrated": result.uncalibrated is None,
            "reason": result.uncalibrated,
            "joint": "probability that the axis is within 5 degrees",
            "part": "probability that the rotation is within 10 degrees",
        },
        "evidence": dict(twin.evidence),
        "warnings": list(twin.warnings),
    }


def _parts(twin: Twin) -> list[dict[str, Any]]:
    known = twin.part_confidence
    return [
        {
            "name": name,
            "points": int((twin.part == p).sum()),
            "camera_T_part": twin.camera_T_part[p].tolist(),
            "confidence": None if known is None else float(known[p]),
        }
        for p, name in enumerate(twin.category.parts)
    ]


def _joints(twin: Twin) -> list[dict[str, Any]]:
    known, parts = twin.joint_confidence, twin.category.parts
    return [
        {
            "kind": spec.kind,
            "parent": parts[spec.parent],
            "child": parts[spec.child],
            "pivot": twin.pivot[j].tolist(),
            "axis": twin.axis[j].tolist(),
            "state": float(twin.state[j]),
            "limits": twin.limits[j].tolist(),
            "confidence": None if known is None else float(known[j]),
        }
        for j, spec in enumerate(twin.category.joints)
    ]


def parts_ply(twin: Twin) -> bytes:
    """The observed points in the project's colours of parts, with a property `part` (255: none)."""
    kind = [*((name, "<f4") for name in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))]
    rows = np.zeros(len(twin.points), np.dtype([*kind, ("part", "u1")]))
    for axis, name in enumerate("xyz"):
        rows[name] = twin.points[:, axis]
    palette = np.array([_rgb(color) for color in (*PART_COLORS, BACKGROUND_COLOR)], np.uint8)
    tint = palette[np.where(twin.part == BACKGROUND, len(PART_COLORS), twin.part)]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = tint[:, channel]
    rows["part"] = twin.part
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment parts: {', '.join(twin.category.parts)}; {BACKGROUND}: none",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue", "part")),
        "end_header\n",
    ]
    return "\n".join(header).encode() + rows.tobytes()


def _rgb(color: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(color.removeprefix("#")))


def write_result(result: Result, folder: Path) -> list[str]:
    """Write the folder of one object, whole or not at all.

    Returns:
        The files in it, by their path within.

    Raises:
        ValueError: Something is in the way that this program did not write.
        OSError: It cannot be written.
    """
    text = json.dumps(joints_record(result), indent=1, allow_nan=False) + "\n"
    with whole_folder(folder) as temporary:
        (temporary / JOINTS).write_text(text, encoding="utf-8")
        (temporary / PARTS).write_bytes(parts_ply(result.twin))
        twin = write_twin(result.twin, temporary / OBJECT)
        own = (temporary / JOINTS, temporary / PARTS)
        write_page(result.twin, temporary / PAGE, (*own, *twin))
        made = sorted(path for path in temporary.rglob("*") if path.is_file())
        return [path.relative_to(temporary).as_posix() for path in made]
