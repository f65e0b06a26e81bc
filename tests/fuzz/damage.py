# SPDX-License-Identifier: MIT
"""Ways to damage a file: its structure node by node, its bytes, its compressed stream.

Every function takes a generator and the good bytes, and gives other bytes; the same generator gives
the same damage.
"""

from __future__ import annotations

import gzip
import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

Damage = Callable[[random.Random, bytes], bytes]
RAW = ("NaN", "-Infinity", "1e999", "9" * 401, "-" + "9" * 25, "1_0", "[" * 5000 + "]" * 5000)
"""Values that only the text of a JSON file can hold."""
VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 1, 2**31, 2**63, 2**70, -(10**30), 0.5, -0.0, 1e308, "", "x", "\0"),
    *(
        "nan",
        "-inf",
        "1_0",
        "\u0663",
        "../../x",
        "a\nb",
        "\x1b[2J",
        "[/x]",
        "x" * 100_000,
        "\ud800",
    ),
    *([], {}, [[]], [None], {"": 0}, [1, 2, 3], [0.0] * 16, {"format": 1}),
)


def in_json(rng: random.Random, data: bytes) -> bytes:
    """One or two nodes of a JSON text deleted, doubled or replaced; or its bytes damaged."""
    if rng.random() < 0.15:
        return in_bytes(rng, data)
    tree = json.loads(data)
    marks: dict[str, str] = {}
    for _ in range(rng.randint(1, 2)):
        tree = _changed(rng, tree, marks)
    text = json.dumps(tree)
    for mark, raw in marks.items():
        text = text.replace(f'"{mark}"', raw)
    return text.encode()


def _changed(rng: random.Random, tree: Any, marks: dict[str, str]) -> Any:
    places: list[tuple[Any, Any]] = [(None, None)]
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        keys = (
            list(node)
            if isinstance(node, dict)
            else range(len(node))
            if isinstance(node, list)
            else ()
        )
        places += [(node, key) for key in keys]
        waiting += [node[key] for key in keys]
    node, key = rng.choice(places)
    kind = rng.random()
    if node is not None and kind < 0.25:
        del node[key]
    elif isinstance(node, list) and kind < 0.35:
        node.append(node[key])
    elif isinstance(node, dict) and kind < 0.35:
        node[rng.choice(("", "x", "format", "\x1b[2J"))] = node.pop(key)
    else:
        value = rng.choice(VALUES)
        if kind > 0.8:
            value = f"mark{len(marks)}"
            marks[value] = rng.choice(RAW)
        if node is None:
            return value
        node[key] = value
    return tree


def in_lines(rng: random.Random, data: bytes) -> bytes:
    """A line of JSON damaged, dropped, doubled or cut."""
    lines = data.splitlines(keepends=True)
    if not lines or rng.random() < 0.2:
        return in_bytes(rng, data)
    k = rng.randrange(len(lines))
    kind = rng.random()
    if kind < 0.6 and lines[k].startswith(b"{"):
        lines[k] = in_json(rng, lines[k]) + b"\n"
    elif kind < 0.7:
        lines.append(lines[k])
    elif kind < 0.8:
        del lines[k]
    else:
        lines[k] = in_bytes(rng, lines[k])
    return b"".join(lines)


def in_bytes(rng: random.Random, data: bytes) -> bytes:
    """Bytes flipped, put in, left out, cut off, or doubled."""
    result = bytearray(data)
    kind = rng.random()
    if kind < 0.2:
        return bytes(result[: rng.randrange(len(result) + 1)])
    if kind < 0.25:
        return data + data
    for _ in range(rng.randint(1, 6)):
        k = rng.randrange(len(result) or 1)
        if rng.random() < 0.6 and result:
            result[k] = rng.choice(
                (0, 255, result[k] ^ (1 << rng.randrange(8)), rng.randrange(256))
            )
        elif rng.random() < 0.5:
            result[k:k] = rng.choice((b"\0", b"\xff" * 8, b"\n", b"-", b"nan ", b"9" * 30))
        else:
            del result[k : k + rng.randint(1, 40)]
    return bytes(result)


def in_head(rng: random.Random, data: bytes) -> bytes:
    """Bytes of the first 200 damaged, where binary formats keep their counts."""
    return in_bytes(rng, data[:200]) + data[200:]


WORDS = (
    *("nan", "inf", "-1", "0", "1e308", "1_0", "\u0663", '""', "<", ">", "/", "&x;", "..", "\0"),
    *("9" * 30, "9" * 400, "1,2,3", "<!--", "-->", "\n", "package://", "f", "v", "usemtl", "l"),
)


def in_words(rng: random.Random, data: bytes) -> bytes:
    """Words of a text exchanged, dropped, or replaced by odd ones."""
    pieces = re.findall(r"[\w.]+|[^\w.]", data.decode("utf-8", "replace"))
    for _ in range(rng.randint(1, 3)):
        if not pieces:
            break
        k = rng.randrange(len(pieces))
        pieces[k] = rng.choice([rng.choice(WORDS), "", pieces[rng.randrange(len(pieces))]])
    return "".join(pieces).encode("utf-8", "replace")


def in_gzip(inner: Damage) -> Damage:
    """What is compressed damaged and compressed again; or the stream itself."""

    def damage(rng: random.Random, data: bytes) -> bytes:
        if rng.random() < 0.3:
            return in_bytes(rng, data)
        return gzip.compress(inner(rng, gzip.decompress(data)), mtime=0)

    return damage


def in_zip(rng: random.Random, data: bytes) -> bytes:
    """A member of the archive damaged, its checksum right; or the archive itself."""
    if rng.random() < 0.3:
        return in_bytes(rng, data)
    result = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as good, zipfile.ZipFile(result, "w") as bad:
        infos = good.infolist()
        struck = rng.choice(infos)
        for info in infos:
            member = good.read(info)
            if info is struck:
                member = rng.choice((in_bytes, in_head))(rng, member)
            bad.writestr(info, member)
    return result.getvalue()


def in_safetensors(rng: random.Random, data: bytes) -> bytes:
    """The header of the file, the JSON within its metadata, or the tensors' bytes."""
    if rng.random() < 0.25:
        return in_bytes(rng, data)
    size = struct.unpack("<Q", data[:8])[0]
    head, body = data[8 : 8 + size], data[8 + size :]
    if rng.random() < 0.7:
        tree = json.loads(head)
        inner = in_json(rng, tree["__metadata__"]["scapo"].encode())
        tree["__metadata__"]["scapo"] = inner.decode("utf-8", "replace")
        head = json.dumps(tree).encode()
    elif rng.random() < 0.7:
        head = in_json(rng, head)
    else:
        body = in_numbers(rng, body)
    return struct.pack("<Q", len(head)) + head + body


def in_numbers(rng: random.Random, data: bytes) -> bytes:
    """Four bytes that are NaN, infinite, huge or odd as numbers."""
    result = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        k = 4 * rng.randrange(max(len(result) // 4, 1))
        value = rng.choice((float("nan"), float("inf"), -3e38, 0.0, 1e30))
        result[k : k + 4] = struct.pack("<f", value)
    return bytes(result[: len(data)])


def in_glb(rng: random.Random, data: bytes) -> bytes:
    """The JSON of a binary glTF, or its buffer."""
    size = struct.unpack("<I", data[12:16])[0]
    if rng.random() < 0.3:
        return in_bytes(rng, data)
    text = in_json(rng, data[20 : 20 + size])
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    total = 20 + len(text) + len(rest)
    return data[:8] + struct.pack("<II", total, len(text)) + data[16:20] + text + rest


def in_png(rng: random.Random, data: bytes) -> bytes:
    """A chunk of a PNG with the right checksum, so that its reader believes it."""
    if rng.random() < 0.4:
        return in_bytes(rng, data)
    head = in_bytes(rng, data[12:29])[:17].ljust(17, b"\0")
    return data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:]
