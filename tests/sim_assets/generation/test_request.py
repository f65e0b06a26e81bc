# SPDX-License-Identifier: MIT
"""From options to a request: what is refused, and models in place of a generator."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import pytest

from sim_assets.generation import shard as shards
from sim_assets.generation.build import build
from sim_assets.generation.generate import Running, generate
from sim_assets.generation.ledger import GenerateError
from sim_assets.generation.plan import Piece
from sim_assets.generation.request import make_request
from sim_assets.generation.shard import render_piece
from sim_assets.generation.stream import stream
from sim_assets.options import DataOptions
from tests.helpers.urdfs import cabinet

FULL = DataOptions(protocol="full", points=64, count=30, instances=5)
"""Needs no renderer."""


def test_options_out_of_range_are_refused():
    for change, message in (
        ({"count": 0}, "count: expected 1 or more, found 0"),
        ({"points": 7}, "points: expected 8 or more, found 7"),
        ({"points": 2**24 + 1}, "points: expected 16777216 or less, found 16777217"),
        (
            {"points": 2**23 + 1, "states_per_view": 2},
            "points: expected 8388608 or less, found 8388609",
        ),
        (
            {"states_per_view": 2**22, "count": 2**22},
            "states_per_view: expected 2097152 or less, found 4194304",
        ),
        ({"instances": 31}, "instances: expected at most 30, the views that count gives, found 31"),
        ({"instances": 7, "states_per_view": 5}, "instances: expected at most 6, the views"),
        ({"states_per_view": 4}, "count: expected a multiple of states_per_view, 4, found 30"),
        ({"image_size": 5000}, "image_size: expected 4096 or less, found 5000"),
        ({"up": "z"}, "expected only with a --source folder"),
        ({"scale": 0.0}, "expected only with a --source folder"),
        (
            {"source": "any", "scale": math.nan},
            "scale: expected a finite number above 0, found nan",
        ),
        ({"source": "any", "scale": 0.0}, "scale: expected a finite number above 0, found 0.0"),
        ({"source": "any", "up": "q"}, "up: expected x, -x, y, -y, z or -z, found 'q'"),
        ({"source": "any", "up": "z", "front": "-Z"}, "front: expected an axis at right angles"),
        ({"source": "/nowhere/at/all"}, "/nowhere/at/all: expected a folder"),
    ):
        with pytest.raises(ValueError, match=message):
            make_request("laptop", replace(FULL, **change))
    with pytest.raises(ValueError, match="category 'chair': expected one of laptop"):
        next(stream("chair"))
    with pytest.raises(TypeError, match="colour"):
        stream("laptop", colour=True)


def test_a_folder_of_models_in_place_of_a_generator(tmp_path, shared_dir):
    source = shared_dir / "assets" / "laptop"
    options = DataOptions(source=str(source), count=12, points=128, protocol="full")
    request, assets = make_request("laptop", options)
    made = generate(request, assets, tmp_path / "split", {}, Running(workers=0))
    assert made.failed == {}
    record = made.manifest.instances[0]
    assert not Path(record.source).is_absolute()
    assert made.manifest.options["source"] == "urdf"
    assert str(source) not in (tmp_path / "split/manifest.json").read_text()


def test_a_full_disk_is_told_in_one_line(tmp_path, monkeypatch):
    def full(*arguments: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shards, "write", full)
    request, assets = make_request("laptop", FULL)
    message = r"split/00000\.safetensors: expected to be written, found: No space left on device"
    with pytest.raises(GenerateError, match=message):
        generate(request, assets, tmp_path / "split", {}, Running(workers=0))
    monkeypatch.setattr("sim_assets.generation.ledger.write_bytes", full)
    with pytest.raises(GenerateError, match=r"other: expected to be written, found: No space"):
        generate(request, assets, tmp_path / "other", {}, Running(workers=0))


def test_a_model_that_has_changed_since_the_plan_is_refused():
    request, (asset, *_) = make_request("laptop", FULL)
    entry = shards.describe(asset, lambda label, amount: None)
    other = replace(entry, instance=replace(entry.instance, sha256="f" * 64))
    piece = Piece(entry=other, index=0, first=0, views=1)
    with pytest.raises(ValueError, match="they have changed since this data set was begun"):
        render_piece(request, piece, None, lambda label, amount: None)
    views = render_piece(request, replace(piece, entry=entry), None, lambda label, amount: None)
    assert len(views) == 1


def test_a_complete_sample_needs_the_whole_surface_and_a_renderer():
    """Its pictures say which views are kept."""
    with pytest.raises(ValueError, match="protocol: expected full with preset sim-art-complete"):
        make_request("laptop", DataOptions(preset="sim-art-complete", protocol="joint"))
    with pytest.raises(ValueError, match="noise and mask: expected none and exact with protocol"):
        make_request("laptop", DataOptions(preset="sim-art-complete", noise="kinect"))
    options = DataOptions(preset="sim-art-complete", backend="raycast", count=8, points=64)
    request, _ = make_request("laptop", options)
    assert (request.settings.protocol, request.settings.backend) == ("full", "raycast")
    assert make_request("laptop", FULL)[0].settings.backend is None


def test_models_may_be_chosen_by_the_caller(tmp_path):
    list(build("laptop", count=3, seed=4, out=tmp_path, split="train"))
    options = DataOptions(source=str(tmp_path), count=4, protocol="full")
    _, every = make_request("laptop", options)
    request, assets = make_request("laptop", options, every[1:])
    assert [asset.name for asset in assets] == [asset.name for asset in every[1:]]
    assert (request.source, request.instances) == ("urdf", 2)


@pytest.mark.parametrize("name", ["up", "any_model"])
def test_how_models_are_read_is_no_question_of_procedural_objects(name):
    value = True if name == "any_model" else "z"
    with pytest.raises(ValueError, match="any_model: expected only with a --source folder"):
        make_request("laptop", replace(FULL, **{name: value}))


def test_a_data_set_says_nothing_of_where_its_source_stood(tmp_path: Path):
    """Whatever a model is left out for: what is written is equal byte for byte."""
    written = []
    for place in ("a", "a very long name, a link and a dot/./b"):
        source = tmp_path / place / "models"
        cabinet(source / "good")
        cabinet(source / "no mesh", ("meshes/door.obj", "meshes/none.obj"))
        cabinet(source / "bad mesh")
        (source / "bad mesh/meshes/door.obj").write_text("v 0 0 nan\nf 1 1 1\n")
        cabinet(source / "fixed", ('type="revolute"', 'type="fixed"'))
        cabinet(source / "pipe")
        (source / "pipe/cabinet.urdf").unlink()
        os.mkfifo(source / "pipe/cabinet.urdf")
        cabinet(source / "speaks of nothing", ("door", "leaf"))
        if written:
            (tmp_path / "link").symlink_to(source)
            source = tmp_path / "link"
        options = DataOptions(source=str(source), count=2, points=64, protocol="full")
        request, assets = make_request("oven", options)
        folder = tmp_path / f"out{len(written)}"
        made = generate(request, assets, folder, {}, Running(workers=0))
        assert set(made.failed) > {"fixed", "pipe"}
        written.append({path.name: path.read_bytes() for path in folder.iterdir()})
    reasons = json.loads(written[0]["manifest.json"])["left_out"]
    assert reasons["pipe"].startswith("pipe/cabinet.urdf: expected a readable file")
    assert str(tmp_path) not in str(written)
    assert written[0] == written[1]
