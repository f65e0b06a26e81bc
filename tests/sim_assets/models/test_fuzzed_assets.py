# SPDX-License-Identifier: MIT
"""Random damage to a model's text and meshes: it is read, or refused, and nothing else."""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest
import trimesh

from sim_assets.models import reader
from sim_assets.models.validate import AssetError
from sim_assets.objects import ArticulatedObject
from tests.helpers.urdfs import BODY, TEXT, cabinet

FORMS = ("obj", "stl", "ply", "glb", "dae")
WORDS = (
    *("nan", "inf", "-1", "0", "1e308", '""', "<", ">", "/", "&x;", "..", "package://", "\0"),
    *("prismatic", "continuous", "fixed", "floating", "mesh", "box", "sphere", "scale", "xyz"),
    *("body", "door", "hinge", "link", "joint", "9" * 30, "1,2,3", "<!--", "-->", "\n", "mimic"),
)
ROUNDS = 60


def damaged_text(rng: random.Random) -> str:
    pieces = re.findall(r"[\w.]+|[^\w.]", TEXT)
    for _ in range(rng.randint(1, 2)):
        k = rng.randrange(len(pieces))
        pieces[k] = rng.choice([rng.choice(WORDS), "", pieces[rng.randrange(len(pieces))]])
    return "".join(pieces)


def damaged_bytes(rng: random.Random, data: bytes) -> bytes:
    result = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        k = rng.randrange(len(result) or 1)
        if rng.random() < 0.5 and result:
            result[k] = rng.randrange(256)
        elif rng.random() < 0.5:
            result[k:k] = rng.choice(WORDS).encode()
        else:
            del result[k : k + rng.randint(1, 20)]
    return bytes(result)


def outcome(urdf: Path) -> bool:
    try:
        thing = reader.read(urdf, "oven", root=urdf.parent)
    except AssetError:
        return False
    assert isinstance(thing, ArticulatedObject)
    return True


@pytest.mark.parametrize("seed", range(3))
def test_damaged_texts(seed: int, tmp_path: Path):
    rng = random.Random(seed)
    urdf = cabinet(tmp_path)
    read = 0
    for _ in range(ROUNDS):
        urdf.write_text(damaged_text(rng), encoding="utf-8")
        read += outcome(urdf)
    assert 0 < read < ROUNDS


@pytest.mark.parametrize("form", FORMS)
def test_damaged_meshes(form: str, tmp_path: Path):
    rng = random.Random(form)
    urdf = cabinet(tmp_path, ("body.obj", f"body.{form}"))
    path = tmp_path / f"meshes/body.{form}"
    trimesh.creation.box(BODY).export(path)
    data = path.read_bytes()
    assert outcome(urdf)
    for _ in range(ROUNDS):
        path.write_bytes(damaged_bytes(rng, data))
        outcome(urdf)
