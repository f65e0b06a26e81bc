# SPDX-License-Identifier: MIT
"""How much the objects of a data set differ, against the same numbers worked out here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scapo.store import Split, open_split, write_bytes
from sim_assets.inspect.variation import Variation
from sim_assets.procedural import generate as make
from tests.helpers.programs import run
from tests.helpers.urdfs import cabinet

FLAT = ("--protocol", "full", "--points", 64, "--workers", 0)


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Split:
    out = tmp_path_factory.mktemp("data")
    flags = ("--count", 10, "--instances", 5, "--seed", 2, "--out", out)
    assert run("generate", "oven", *flags, *FLAT) == 0
    return open_split(out, "oven")


def test_coefficients_of_the_boxes(split: Split):
    sides = np.stack([make("oven", "train", 2, index).extents() for index in range(5)])
    rows = {row.name: row for row in Variation().measured(split)}
    for name, ratio in (
        ("depth/width", sides[:, 0] / sides[:, 1]),
        ("height/width", sides[:, 2] / sides[:, 1]),
    ):
        assert rows[name].count == 5
        assert rows[name].variation == pytest.approx(ratio.std() / ratio.mean())
        assert (rows[name].low, rows[name].high) == pytest.approx((ratio.min(), ratio.max()))


def test_info_prints_it(split: Split, capsys):
    assert run("info", split.folder) == 0
    text = capsys.readouterr().out
    rows = {row.name: row for row in Variation().measured(split)}
    assert f"  variation  depth/width {rows['depth/width'].variation:.2f}, height/width" in text
    assert "(coefficient, of 5 objects)" in text
    assert "deg from the nearest side of the box" in text


def test_objects_that_cannot_be_had_again_are_said(split: Split, tmp_path: Path):
    manifest = split.manifest
    other = replace(manifest.instances[0], sha256="0" * 64)
    changed = replace(manifest, instances=(other, *manifest.instances[1:]))
    write_bytes(tmp_path / "manifest.json", changed.to_json().encode())
    (line,) = Variation().lines(Split(tmp_path))
    assert line.startswith("  variation  unknown: oven-train-2-00000: expected the object that")


def test_models_are_measured_where_they_are_at_hand(tmp_path: Path):
    """Two equal cabinets do not differ; without their folder nothing is said."""
    for name in ("a", "b"):
        cabinet(tmp_path / "models" / name)
    source = ("--source", tmp_path / "models", "--out", tmp_path / "data", "--count", 4)
    assert run("generate", "safe", *source, *FLAT) == 0
    split = open_split(tmp_path / "data", "safe")
    assert Variation().lines(split) == []
    line, axes = Variation(tmp_path / "models").lines(split)
    assert "depth/width 0.00, height/width 0.00, door/body 0.00" in line
    assert axes == "  axes       0.0 +- 0.0 deg from the nearest side of the box"
