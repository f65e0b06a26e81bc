# SPDX-License-Identifier: MIT
"""Damage that once came through: every case is played again by the tests, in this order.

Add to the end what a long run finds: the format, and what it did to the good bytes.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable
from typing import Any

Change = Callable[[bytes], bytes]
MARK = "the place of the node"


def node(raw: str, *keys: Any) -> Change:
    """A node of a JSON text replaced by a raw text, which need not be JSON."""

    def change(data: bytes) -> bytes:
        tree = json.loads(data)
        inner = tree
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = MARK
        return json.dumps(tree).replace(f'"{MARK}"', raw).encode()

    return change


def header(inner: Change) -> Change:
    """The JSON in the metadata of a safetensors file changed."""

    def change(data: bytes) -> bytes:
        size = struct.unpack("<Q", data[:8])[0]
        tree = json.loads(data[8 : 8 + size])
        text = tree["__metadata__"]["scapo"]
        tree["__metadata__"]["scapo"] = inner(text.encode()).decode()
        head = json.dumps(tree).encode()
        return struct.pack("<Q", len(head)) + head + data[8 + size :]

    return change


def bytes_of(old: bytes, new: bytes) -> Change:
    """The first of some bytes replaced."""

    def change(data: bytes) -> bytes:
        assert old in data
        return data.replace(old, new, 1)

    return change


def member(ending: str, inner: Change) -> Change:
    """A member of a zip archive changed, its checksum right."""

    def change(data: bytes) -> bytes:
        result = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as good, zipfile.ZipFile(result, "w") as bad:
            for info in good.infolist():
                content = good.read(info)
                bad.writestr(info, inner(content) if info.filename.endswith(ending) else content)
        return result.getvalue()

    return change


SECONDS = ("splits", "a", "seconds")
UNPRINTABLE = b"\x1b[2J" * 600
"""A name that is no name."""
FOUND: tuple[tuple[str, Change], ...] = (
    ("benchmark record", node(json.dumps("x" * 100_000), "format")),
    ("benchmark record", node(json.dumps(["\x1b[2J\ud800" * 20_000]), "format")),
    ("benchmark record", node("1e999", *SECONDS)),
    ("benchmark record", node("-1e999", *SECONDS)),
    ("training state", header(node("1e999", "position", "seconds"))),
    ("training state", header(node("1e999", "header", "training", "clip"))),
    ("checkpoint", header(node("1e999", "training", "clip"))),
    ("shard", header(node("1e999", "seed"))),
    ("shape2motion NPY", bytes_of(b"numpy", UNPRINTABLE)),
    ("OP-Align PT", member("data.pkl", bytes_of(b"torch", UNPRINTABLE))),
    ("manifest", node('"../../evil"', "category")),
    ("manifest", node('"/etc/evil"', "category")),
    ("manifest", node('".."', "split")),
    ("manifest", node("1000000000000", "points")),
    ("manifest", lambda data: b'{"count": 3,' + data.lstrip()[1:]),
    ("DAE", bytes_of(b"<asset>", b'<asset><unit name="x" meter="nan"/>')),
    ("DAE", bytes_of(b"<asset>", b'<asset><unit name="x" meter="0"/>')),
    ("DAE", bytes_of(b"<asset>", b'<asset><unit name="x" meter="-1"/>')),
    ("URDF", bytes_of(b'xyz="0 0 -1"', b'xyz="0 0 -1e308"')),
    ("URDF", bytes_of(b'scale="1 1 1"', b'scale="1e-300 1e-300 1e-300"')),
)
"""Format, and what was done to its good file."""
