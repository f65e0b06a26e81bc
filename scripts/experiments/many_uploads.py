#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""Is each of many clouds that are dropped on the demo's page at once answered with its own result?

    python scripts/experiments/many_uploads.py DATA laptop oven [--count 50] [--mode quick]

Starts `scapo-bench demo` with the released models and uploads clouds of DATA's `val` by turns. Of
each answer the name, the category, the points of `parts.ply`, the page and the URDF are looked at.
Prints how many are right, times, and the memory of the server.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import trimesh
from werkzeug.datastructures import FileStorage
from werkzeug.test import encode_multipart

from scapo.store import open_split

PATIENCE = 3600.0
"""Seconds that an upload may wait."""


@dataclass(frozen=True, kw_only=True)
class Upload:
    """A cloud and what becomes of it."""

    name: str
    category: str
    points: np.ndarray


def get(port: int, path: str) -> bytes:
    """What the server has there; nothing unless it says 200."""
    connection = HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    connection.request("GET", path)
    answer = connection.getresponse()
    data = answer.read()
    return data if answer.status == 200 else b""


def send(port: int, one: Upload) -> str:
    """Where the server says that the result is; empty where it refuses."""
    stream = io.BytesIO()
    np.savez(stream, points=one.points)
    file = FileStorage(io.BytesIO(stream.getvalue()), f"{one.name}.npz")
    boundary, body = encode_multipart({"category": one.category, "input": file})
    connection = HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    kind = {"Content-Type": f"multipart/form-data; boundary={boundary}"}
    connection.request("POST", "/results", body, kind)
    answer = connection.getresponse()
    answer.read()
    return answer.getheader("Location") or ""


def is_own(port: int, one: Upload, place: str) -> bool:
    """Whether a result is of this cloud."""
    if not place:
        return False
    record, parts, urdf = (
        get(port, place.replace("page.html", name))
        for name in ("joints.json", "parts.ply", "object/mobility.urdf")
    )
    said = json.loads(record)
    scene = trimesh.load_scene(io.BytesIO(parts), file_type="ply", process=False)
    same = np.array_equal(scene.geometry["geometry_0"].vertices.astype(np.float32), one.points)
    named = said["input"] == one.name and said["category"]["name"] == one.category
    return same and named and one.name.encode() in get(port, place) and b"<robot" in urdf


def used(pid: int) -> str:
    """Processor time and most memory of a process so far."""
    ticks = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    peak = re.findall(r"VmHWM:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())[0]
    seconds = sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
    return f"{seconds:.0f} s of processor time, {int(peak) / 1e6:.2f} GB at most"


def main() -> None:
    """Upload, compare, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("category", nargs="+")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--mode", default="quick")
    given = parser.parse_args()
    clouds = {name: open_split(given.data, name, "val").arrays("points")["points"]
              for name in given.category}  # fmt: skip
    uploads = []
    for k in range(given.count):
        name = given.category[k % len(given.category)]
        points = clouds[name][k * len(clouds[name]) // given.count]
        uploads.append(Upload(name=f"{name}-{k}", category=name, points=points))
    command = [sys.executable, "-m", "bench", "demo", "--port", "0", "--mode", given.mode]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        said = server.stdout.readline() if server.stdout else ""
        port = int(re.findall(r":(\d+)/", said)[0])
        print(f"at rest: {used(server.pid)}")
        began = time.monotonic()
        with ThreadPoolExecutor(given.count) as pool:
            places = list(pool.map(lambda one: send(port, one), uploads))
        print(f"{sum(map(bool, places))} of {given.count} answered in "
              f"{time.monotonic() - began:.0f} s: {used(server.pid)}")  # fmt: skip
        own = sum(is_own(port, one, place) for one, place in zip(uploads, places, strict=True))
        print(f"{own} with their own result")
        server.send_signal(signal.SIGINT)


if __name__ == "__main__":
    main()
