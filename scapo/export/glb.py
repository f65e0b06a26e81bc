# SPDX-License-Identifier: MIT
"""Write an articulated object as one GLB file (glTF 2.0), a node per link.

glTF knows no joints: each link's node sits at its joint's pivot and carries kind, axis, limits and
the state that the file shows in its `extras`, so that a viewer can turn it. A root node turns z up
into glTF's y up.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scapo.export.urdf import Joint, Link, Surface, link_origins
from scapo.store import write_bytes

_Z_UP_TO_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
"""A quarter turn about -x as a quaternion xyzw."""
_VERTICES, _INDICES = 34962, 34963
_CODES = {"float32": 5126, "uint32": 5125}


def write_glb(
    path: Path,
    links: Sequence[Link],
    joints: Sequence[Joint],
    state: Mapping[str, float] | None = None,
) -> None:
    """Write the object as a GLB file, atomically; equal input gives equal bytes.

    Args:
        path: The file, usually `*.glb`.
        links: As for `scapo.export.urdf.write_urdf`.
        joints: As for `scapo.export.urdf.write_urdf`.
        state: Joint name -> state in rad or m; rest where not named.
    """
    tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "scapo"}, "scene": 0}
    for key in ("bufferViews", "accessors", "materials", "meshes"):
        tree[key] = []
    frames = link_origins(links, joints)
    data = bytearray()
    nodes: list[dict[str, Any]] = [{"name": "object", "rotation": _Z_UP_TO_Y_UP, "children": [1]}]
    for link in links:
        node: dict[str, Any] = {"name": link.name}
        if link.surfaces:
            node["mesh"] = len(tree["meshes"])
            pieces = [_primitive(tree, data, s, frames[link.name]) for s in link.surfaces]
            tree["meshes"].append({"name": link.name, "primitives": pieces})
        nodes.append(node)
    index = {link.name: number + 1 for number, link in enumerate(links)}
    for joint in joints:
        nodes[index[joint.parent]].setdefault("children", []).append(index[joint.child])
        offset = np.asarray(joint.pivot, float) - frames[joint.parent]
        nodes[index[joint.child]] |= _motion(joint, offset, (state or {}).get(joint.name, 0.0))
    tree |= {"nodes": nodes, "scenes": [{"nodes": [0]}], "buffers": [{"byteLength": len(data)}]}
    write_bytes(path, _container(tree, bytes(data)))


def _motion(joint: Joint, offset: np.ndarray, state: float) -> dict[str, Any]:
    """Pose of a child's node in its parent's, and the joint as extra data."""
    axis = np.asarray(joint.axis, float)
    extras = {"joint": joint.name, "kind": joint.kind, "axis": axis.tolist()}
    extras |= {"lower": joint.lower, "upper": joint.upper, "state": state}
    if joint.kind == "prismatic":
        return {"translation": (offset + axis * state).tolist(), "extras": extras}
    rotation = [*(axis * np.sin(state / 2)).tolist(), float(np.cos(state / 2))]
    return {"translation": offset.tolist(), "rotation": rotation, "extras": extras}


def _primitive(
    tree: dict[str, Any], data: bytearray, surface: Surface, origin: np.ndarray
) -> dict[str, Any]:
    """Append a surface's arrays and material; returns the glTF primitive."""
    vertices = (np.asarray(surface.vertices, float) - origin).astype(np.float32)
    faces = np.asarray(surface.faces).astype(np.uint32).reshape(-1)
    material = {
        "pbrMetallicRoughness": {
            "baseColorFactor": [*map(_linear, surface.color[:3]), float(surface.color[3])],
            "metallicFactor": 0.0,
            "roughnessFactor": 0.8,
        }
    }
    tree["materials"].append(material)
    return {
        "attributes": {"POSITION": _accessor(tree, data, vertices, _VERTICES)},
        "indices": _accessor(tree, data, faces, _INDICES),
        "material": len(tree["materials"]) - 1,
    }


def _linear(value: float) -> float:
    """A value of sRGB as glTF's factors have it."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def _accessor(tree: dict[str, Any], data: bytearray, array: np.ndarray, target: int) -> int:
    """Append an array to the buffer; returns its accessor's index."""
    view = {"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes, "target": target}
    accessor: dict[str, Any] = {
        "bufferView": len(tree["bufferViews"]),
        "componentType": _CODES[array.dtype.name],
        "count": len(array),
        "type": "VEC3" if array.ndim == 2 else "SCALAR",
    }
    if array.ndim == 2:
        accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
    tree["bufferViews"].append(view)
    tree["accessors"].append(accessor)
    data += array.tobytes()
    return len(tree["accessors"]) - 1


def _container(tree: dict[str, Any], data: bytes) -> bytes:
    """The GLB container: a 12-byte header, a JSON chunk, a binary chunk, little endian."""
    text = json.dumps(tree, sort_keys=True, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    total = 12 + 8 + len(text) + 8 + len(data)
    return (
        struct.pack("<III", 0x46546C67, 2, total)
        + struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(data), 0x004E4942)
        + data
    )
