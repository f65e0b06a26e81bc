# SPDX-License-Identifier: MIT
"""What is written says what was found, and is read by others."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh

from bench.infer.files import Choice, Result, joints_record, parts_ply, write_result
from bench.twin.record import BACKGROUND, Twin
from scapo.categories import CATEGORIES
from scapo.drawing import PART_COLORS

RNG = np.random.default_rng(0)


@pytest.fixture
def result() -> Result:
    twin = Twin(
        name="kitchen", category=CATEGORIES["eyeglasses"],
        points=RNG.normal(size=(50, 3)).astype(np.float32),
        part=np.array([0] * 20 + [1] * 15 + [2] * 10 + [BACKGROUND] * 5),
        camera_T_part=np.eye(4)[None].repeat(3, 0), pivot=RNG.normal(size=(2, 3)),
        axis=np.eye(3)[:2], state=np.array([0.5, 1.0]), limits=np.array([[0, 1.0], [0, 1.4]]),
        evidence={"residual": 0.2}, warnings=("one",), model={"name": "m"},
    )  # fmt: skip
    choice = Choice(by="residual", residuals={"eyeglasses": 0.2, "oven": 0.5, "safe": 0.4})
    return Result(twin=twin, choice=choice, mode="quick", uncalibrated="why", aligned=False)


def test_the_record_says_what_was_found(result, tmp_path):
    files = write_result(result, tmp_path / "kitchen")
    wanted = {"joints.json", "parts.ply", "page.html", "object/mobility.urdf", "object/twin.glb"}
    assert wanted <= set(files)
    record = json.loads((tmp_path / "kitchen" / "joints.json").read_text())
    assert record["format"] == "scapo-joints/1"
    assert record["category"]["margin"] == pytest.approx(0.2)
    assert record["model"] == {"name": "m", "mode": "quick"}
    assert [part["points"] for part in record["parts"]] == [20, 15, 10]
    assert [joint["child"] for joint in record["joints"]] == ["left temple", "right temple"]
    assert record["joints"][1]["limits"] == [0, 1.4]
    assert record["joints"][0]["confidence"] is None
    assert record["confidence"]["reason"] == "why"
    assert record["warnings"] == ["one"]
    sure = replace(result.twin, joint_confidence=np.array([0.9, 0.1]))
    known = joints_record(replace(result, twin=sure, uncalibrated=None))
    assert known["confidence"]["calibrated"]
    assert known["joints"][1]["confidence"] == 0.1


def test_one_model_has_no_margin():
    assert Choice(by="run", residuals={"oven": 0.2}).margin is None


def test_points_are_coloured_by_part(result, tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(parts_ply(result.twin))
    found: Any = trimesh.load(path)
    np.testing.assert_allclose(found.vertices, result.twin.points, rtol=1e-6)
    wanted = np.array([bytes.fromhex(PART_COLORS[1][1:])]).view(np.uint8)
    assert (found.colors[20:35, :3] == wanted).all()
    assert len(np.unique(found.colors, axis=0)) == 4


def test_the_same_input_gives_the_same_bytes_and_replaces_them(result, tmp_path):
    write_result(result, tmp_path / "a")
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir() if path.is_file()}
    write_result(result, tmp_path / "a")
    after = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir() if path.is_file()}
    assert before == after
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mine.txt").write_text("x")
    with pytest.raises(ValueError, match="expected"):
        write_result(result, tmp_path / "b")
    assert (tmp_path / "b" / "mine.txt").read_text() == "x"
