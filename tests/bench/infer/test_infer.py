# SPDX-License-Identifier: MIT
"""`scapo-bench infer` on files of all kinds, some of them broken, by a model from a run folder."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation

from bench import __main__ as program
from bench.infer.cloud import Cloud, InputError
from bench.infer.infer import Done, answer, distinct_names, summary
from scapo.categories import CATEGORIES
from tests.helpers.placed import Told, placed_run, told_model


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return placed_run(tmp_path_factory.mktemp("run") / "oven")


@pytest.fixture(scope="module")
def told() -> Told:
    return Told(2)


def call(*words: object) -> int | str | None:
    try:
        program.main([str(word) for word in words])
    except SystemExit as ended:
        return ended.code
    return 0


def test_a_cloud_and_a_depth_image_of_it_are_answered(run, told, tmp_path, capsys):
    points = told.clouds()[0]
    np.savez(tmp_path / "cloud.npz", points=points)
    rng, depth = np.random.default_rng(0), np.zeros((120, 160), np.uint16)
    ahead = Rotation.align_vectors([[0, 0, 1]], points.mean(0)[None])[0].apply(points)
    for _ in range(20):  # splats: the cloud is sparse
        near = ahead + rng.normal(scale=0.012, size=points.shape)
        u, v = (near[:, :2] / near[:, 2:] * 150 + [80, 60]).astype(int).T
        shown = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
        depth[v[shown], u[shown]] = (1000 * near[shown, 2]).astype(np.uint16)
    Image.fromarray(depth).save(tmp_path / "image.png")
    (tmp_path / "image.json").write_text('{"fx": 150, "fy": 150, "cx": 80, "cy": 60}')
    Image.fromarray((depth > 0).astype(np.uint8)).save(tmp_path / "image.mask.png")
    (tmp_path / "broken.ply").write_bytes(b"ply\n")
    out = tmp_path / "out"
    code = call("infer", tmp_path, "--run", run, "--mode", "fast", "--out", out, "--device", "cpu")
    said = capsys.readouterr()
    assert code == 1
    assert "broken.ply: expected a PLY header with vertices" in said.err
    assert "expected 3 answers, found 2" in said.err
    assert "cloud.npz: oven, door " in said.out
    records = [json.loads((out / name / "joints.json").read_text()) for name in ("cloud", "image")]
    assert {path.name for path in out.iterdir()} == {"cloud", "image"}
    for record in records:
        assert record["category"]["chosen_by"] == "run"
        assert record["model"]["name"] == "oven"
        assert record["confidence"]["calibrated"] is False
        assert len(record["joints"]) == 1
    assert records[0]["parts"][0]["points"] + records[0]["parts"][1]["points"] > 200


@pytest.mark.parametrize(
    ("data", "message"),
    [(b"", "expected a readable .npz"), (None, "expected a file, found none")],
)
def test_a_single_failure_is_one_line(data, message, run, tmp_path, capsys):
    path = tmp_path / "a.npz"
    if data is not None:
        path.write_bytes(data)
    assert call("infer", path, "--run", run, "--out", tmp_path / "out") == 1
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["a.npz", "a.png"])
def test_a_scale_of_zero_is_refused_for_clouds_and_images(name, run, tmp_path, capsys):
    out = tmp_path / "out"
    assert call("infer", tmp_path / name, "--run", run, "--out", out, "--scale", "0") == 1
    assert "--scale: expected a finite number above 0, found 0" in capsys.readouterr().err


def test_an_up_is_refused_that_is_no_direction_or_of_no_use(run, tmp_path, capsys):
    words = ("infer", tmp_path / "a.npz", "--run", run, "--out", tmp_path / "out", "--up")
    assert call(*words, "0", "0", "0") == 1
    assert "--up: expected a direction, found 0 0 0" in capsys.readouterr().err
    assert call(*words, "0", "-1", "nan") == 1
    assert "--up: expected a finite number, found nan" in capsys.readouterr().err
    assert call(*words, "0", "-1", "0") == 2
    assert "--up: expected a model that can use it, found oven" in capsys.readouterr().err


def test_a_cloud_stands_as_it_is_said_to(tmp_path, capsys):
    points = load_file("results/checks/oven.safetensors")["points"][0]
    np.savez(tmp_path / "a.npz", points=points)
    up = np.array([0.1, -0.9, -0.4])
    out = tmp_path / "out"
    assert call("infer", tmp_path / "a.npz", "--category", "oven", "--out", out, "--up", *up) == 0
    capsys.readouterr()
    record = json.loads((out / "a" / "joints.json").read_text())
    pose = np.array(record["parts"][0]["camera_T_part"])
    np.testing.assert_allclose(pose[:3, 2], up / np.linalg.norm(up), atol=2e-3)


def test_no_input_is_wrong_usage(tmp_path, capsys):
    assert call("infer", "--out", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert said == "scapo-bench: INPUT: expected one or more, found none\n"
    assert call("infer", "--help") == 0
    assert "(default: )" not in capsys.readouterr().out


def test_a_missing_model_is_said_before_anything_is_read(tmp_path, capsys):
    assert call("infer", "none.ply", "--run", tmp_path / "no", "--out", tmp_path / "out") == 1
    assert "expected a run folder" in capsys.readouterr().err


def test_the_model_that_explains_the_view_answers(told):
    cloud = Cloud(points=told.clouds()[0])
    right, turned = told_model(told), Told(2, wrong={0: 0.6})
    other = replace(told_model(turned), category=CATEGORIES["safe"])
    found = answer("a", cloud, [other, right], "fast", "category")
    assert found.twin.category.name == "oven"
    assert found.choice.by == "residual"
    assert found.choice.margin is not None
    assert found.choice.margin > 0.1
    turned.wrong = {}
    close = answer("a", cloud, [other, right], "fast", "category")
    assert close.choice.margin == pytest.approx(0)
    assert "the category is doubtful" in close.twin.warnings[-1]


def test_the_confidence_in_the_line_is_of_the_axis(told):
    """It says nothing of the state; a model with zeros of its own does not know what is open."""
    cloud = Cloud(points=told.clouds()[0])
    found = answer("a", cloud, [told_model(told)], "fast", "category")
    twin = replace(found.twin, state=np.array([0.75]), joint_confidence=np.array([0.974]))
    done = Done(source=Path("a"), result=replace(found, twin=twin, aligned=True))
    assert "door open 43.0 degrees (axis 97 % sure within 5 degrees)" in summary(done)
    done = Done(source=Path("a"), result=replace(found, twin=twin, aligned=False))
    assert "oven, door 43.0 degrees (axis 97 % sure" in summary(done)


def test_names_of_folders_are_distinct():
    paths = [Path("a/x.ply"), Path("a/x.npz"), Path("a/y.png")]
    assert distinct_names(paths) == ["x.ply", "x.npz", "y"]
    with pytest.raises(InputError, match="distinct, plain names"):
        distinct_names([Path("a/x.ply"), Path("b/x.ply")])
