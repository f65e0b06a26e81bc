# SPDX-License-Identifier: MIT
"""A twin as one HTML page that needs no other file and no network.

`page.html` is its text, `page.js` draws; both are put together here with the numbers, the geometry
(base64) and the files to download. Everything that comes from outside is escaped.
"""

from __future__ import annotations

import base64
import io
import json
import math
import re
import zipfile
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bench.twin.articulated import Articulated, articulated, root_from_camera
from bench.twin.record import BACKGROUND, Twin
from scapo.drawing import BACKGROUND as BACKGROUND_COLOR
from scapo.drawing import PART_COLORS
from scapo.geometry.matrices import moved
from scapo.store import write_bytes

MAX_POINTS = 2_000
"""Of a cloud that are shown: of more so many, drawn at random, since dense ones would hide the
parts that the sliders move."""
MAX_DOWNLOAD = 20 * 1024 * 1024
"""Bytes of a file that the page carries; larger ones are named."""
SEEN = (0.02, 0.98)
"""Quantiles of the coordinates that count as the object's ends."""
DIGEST = 12
"""Characters of the checkpoint's digest that are shown."""
AXIS = 0.55
"""Half the length of a drawn axis, in radii of the object."""


def write_page(twin: Twin, path: Path, downloads: Sequence[Path] = ()) -> Path:
    """Write the page of a twin, whole or not at all; equal input gives equal bytes.

    Args:
        twin: What was observed and predicted.
        path: Usually `*.html`.
        downloads: Files of `write_twin`, and others, that it carries: the URDF and its meshes as
            one zip, others one by one.

    Raises:
        OSError: A file cannot be read or written.
    """
    made = articulated(twin)
    title = f"{twin.name}: {twin.category.name}"
    fields = {
        "TITLE": escape(title),
        "LEAD": escape(_lead(twin)),
        "SCENE": escape(f"The {twin.category.name} in three dimensions; the numbers are below."),
        "WARNINGS": _warnings(twin, made),
        "SLIDERS": "".join(_slider(twin, j) for j in range(len(twin.state))),
        "NUMBERS": _numbers(twin),
        "FILES": _files(downloads),
        "DATA": json.dumps(_geometry(twin, made), sort_keys=True).replace("<", "\\u003c"),
        "SCRIPT": _text("page.js"),
    }
    page = re.sub("@([A-Z]+)@", lambda found: fields[found[1]], _text("page.html"))
    write_bytes(path, page.encode())
    return path


def _text(name: str) -> str:
    return (files("bench.twin") / name).read_text(encoding="utf-8")


def _lead(twin: Twin) -> str:
    points = f"{len(twin.points):,} observed points"
    short = {"sha256": twin.model["sha256"][:DIGEST]} if "sha256" in twin.model else {}
    model = ", ".join(f"{name} {text}" for name, text in {**twin.model, **short}.items())
    return f"{points}; model: {model}" if model else points


def _warnings(twin: Twin, made: Articulated) -> str:
    bare = [link.name for link in made.links if not link.surfaces]
    lines = [
        *twin.warnings,
        *(f"{name}: no point of it was seen; it has no surface" for name in bare),
    ]
    if not lines:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<div id="warnings" role="note" aria-label="Warnings"><ul>{items}</ul></div>'


def _in_words(value: float, kind: str) -> str:
    return f"{100 * value:.1f} cm" if kind == "prismatic" else f"{math.degrees(value):.1f}°"


def _slider(twin: Twin, j: int) -> str:
    """The control of one joint, from its lower to its upper limit."""
    spec, (low, high) = twin.category.joints[j], twin.limits[j].tolist()
    state, name = float(twin.state[j]), escape(twin.category.parts[spec.child])
    words = _in_words(state, spec.kind)
    swatch = f'<span class="swatch" style="background:{_color(spec.child)}"></span>'
    return (
        f'<div class="joint"><label for="joint-{j}"><span>{swatch}{name}, {spec.kind}</span>'
        f'<output id="value-{j}" for="joint-{j}">{words}</output></label>'
        f'<input type="range" id="joint-{j}" min="{low!r}" max="{high!r}" step="any" '
        f'value="{state!r}" aria-valuetext="{words}">'
        f'<div class="ends"><span>{_in_words(low, spec.kind)}</span>'
        f"<span>{_in_words(high, spec.kind)}</span></div></div>"
    )


def _color(part: int) -> str:
    return BACKGROUND_COLOR if part == BACKGROUND else PART_COLORS[part % len(PART_COLORS)]


def _numbers(twin: Twin) -> str:
    """Joints and parts as tables, with how sure they are."""
    joints = []
    for j, spec in enumerate(twin.category.joints):
        known = twin.joint_confidence
        sure = "not calibrated" if known is None else f"{known[j]:.0%} within 5°"
        joints.append(
            [
                twin.category.parts[spec.child],
                _vector(100 * twin.pivot[j], 1),
                _vector(twin.axis[j], 3),
                _in_words(float(twin.state[j]), spec.kind),
                sure,
            ]
        )
    parts = []
    for p, name in enumerate(twin.category.parts):
        known = twin.part_confidence
        sure = "not calibrated" if known is None else f"{known[p]:.0%} within 10°"
        parts.append([name, f"{int((twin.part == p).sum()):,}", sure])
    heads = ["joint of", "pivot, cm", "axis", "state", "confidence of the axis"]
    frame = "camera's frame: x right, y down, z forward" if twin.frame == "camera" else (
        "frame of the input"
    )  # fmt: skip
    text = _table(f"Joints in the {frame}.", heads, joints)
    text += _table("Parts.", ["part", "points", "confidence of the rotation"], parts)
    if twin.evidence:
        rows = [[name, f"{value:.4g}"] for name, value in sorted(twin.evidence.items())]
        words = "What they are made of: losses of the view, 0 to about 3, and spreads in degrees."
        text += _table(words, ["evidence", "value"], rows)
    return text


def _vector(values: Float[np.ndarray, " 3"], digits: int) -> str:
    return ", ".join(
        f"{value:.{digits}f}" for value in np.round(values.astype(float), digits) + 0.0
    )


def _table(caption: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "".join(f'<th scope="col">{escape(head)}</th>' for head in heads)
    lines = "".join(
        f'<tr><th scope="row">{escape(name)}</th>'
        + "".join(f"<td>{escape(value)}</td>" for value in rest)
        + "</tr>"
        for name, *rest in rows
    )
    return f"<table><caption>{escape(caption)}</caption><tr>{top}</tr>{lines}</table>"


def _files(downloads: Sequence[Path]) -> str:
    """Links that carry the files themselves."""
    urdf = [path for path in downloads if path.suffix in (".urdf", ".srdf", ".obj")]
    carried = [("urdf.zip", _zip(urdf))] if urdf else []
    carried += [(path.name, path.read_bytes()) for path in downloads if path not in urdf]
    items = "".join(f"<li>{_download(name, content)}</li>" for name, content in carried)
    return f'<ul class="files">{items}</ul>' if items else '<p class="dim">None.</p>'


def _download(name: str, content: bytes) -> str:
    size = f"{math.ceil(len(content) / 1024):,} KiB"
    if len(content) > MAX_DOWNLOAD:
        return f"{escape(name)} ({size}): too large for this page"
    kind = {"glb": "model/gltf-binary", "json": "application/json", "zip": "application/zip"}
    media = kind.get(name.rpartition(".")[2], "application/octet-stream")
    data = base64.b64encode(content).decode()
    shown = escape(name)
    return f'<a download="{shown}" href="data:{media};base64,{data}">{shown}</a> ({size})'


def _zip(paths: Sequence[Path]) -> bytes:
    """A zip without dates, so that equal files give equal bytes; names below the URDF's folder."""
    folder = next((path.parent for path in paths if path.suffix == ".urdf"), paths[0].parent)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in paths:
            entry = zipfile.ZipInfo(path.relative_to(folder).as_posix())
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, path.read_bytes())
    return buffer.getvalue()


def _geometry(twin: Twin, made: Articulated) -> dict[str, Any]:
    """What `page.js` draws, as observed, in the camera's frame."""
    parts = [_part(twin, made, part) for part in range(len(made.links))]
    cloud = twin.points[_drawn(len(twin.points))]
    label = twin.part[_drawn(len(twin.points))]
    low, high = np.quantile(cloud[label != BACKGROUND] if (label != BACKGROUND).any() else cloud,
                            SEEN, axis=0)  # fmt: skip
    centre, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    return {
        "centre": centre.tolist(),
        "radius": radius,
        "look": _look(centre).T.ravel().tolist(),
        "parts": parts,
        "clouds": [
            {"color": _rgb(part), "points": _packed(cloud[label == part], np.float32)}
            for part in sorted(set(label.tolist()))
        ],
        "joints": [
            {
                "kind": spec.kind,
                "parent": spec.parent,
                "child": spec.child,
                "pivot": twin.pivot[j].tolist(),
                "axis": (twin.axis[j] / np.linalg.norm(twin.axis[j])).tolist(),
                "state": float(twin.state[j]),
                "reach": AXIS * radius,
            }
            for j, spec in enumerate(twin.category.joints)
        ],
    }


def _drawn(count: int) -> np.ndarray:
    return np.random.default_rng(0).permutation(count)[:MAX_POINTS]  # no stripes of a raster


def _part(twin: Twin, made: Articulated, part: int) -> dict[str, Any]:
    """Colour and surface of a part where it was observed."""
    shown: dict[str, Any] = {"color": _rgb(part)}
    for surface in made.links[part].surfaces:
        camera_T_root = np.linalg.inv(root_from_camera(twin)[part])
        shown["vertices"] = _packed(moved(surface.vertices, camera_T_root), np.float32)
        shown["faces"] = _packed(surface.faces, np.uint32)
    return shown


def _rgb(part: int) -> list[float]:
    return [value / 255 for value in bytes.fromhex(_color(part)[1:])]


def _packed(values: np.ndarray, kind: type[np.generic]) -> str:
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()


def _look(centre: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """The turn of the drawing's frame (y up, z back) that brings the object before the eye."""
    ahead = centre * (1, -1, -1)
    length = float(np.linalg.norm(ahead))
    made = np.eye(4)
    if length > 0:
        back = -ahead / length
        right = np.cross((0, 1, 0), back)
        if np.linalg.norm(right) > 1e-6:
            right = right / np.linalg.norm(right)
            made[:3, :3] = np.stack([right, np.cross(back, right), back])
    return made
