# SPDX-License-Identifier: MIT
"""From files to files: what `scapo-bench evaluate` does."""

from __future__ import annotations

import gzip
import json

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from bench import __main__ as program
from bench.cli.verbs import VERBS
from bench.metrics import sample_errors
from bench.requests import Request, Settings
from bench.scoring.evaluate import evaluate
from bench.scoring.score_files import COLUMNS
from bench.scoring.summary import passes
from scapo import categories
from scapo.store import Split, StoreError
from scapo.store.provenance import commit, machine
from scapo.store.split import data_name
from tests.helpers import made
from tests.helpers.scoring import root, score


def test_the_truth_scores_one_and_zero(split, tmp_path):
    for supervision in ((), ("pose", "segmentation", "joint")):
        errors, report = score(split, made.truth_as_prediction(split), tmp_path,
                               supervision=supervision)  # fmt: skip
        for (name, unit), value in errors.items():
            expected = {"iou": 1, "order": np.arange(value.shape[1])}.get(name, 0)
            np.testing.assert_allclose(value, np.broadcast_to(expected, value.shape), atol=1e-6,
                                       err_msg=f"{name} {unit}")  # fmt: skip
        assert report["counts"]["samples"] == 11
        assert all(row["undefined"] == 0 for row in report["summary"].values())
        precision = report["average_precision"]
        assert all(precision[k]["k"] == precision[k]["n"] == 11 for k in precision if k != "rule")


def perturbed(arrays):
    """Every part turned by 7 degrees about its own origin and moved by 3 cm; axes turned by 7
    degrees, pivots moved by 3 cm across the axis, states by 7 degrees or 3 cm."""
    generator = np.random.default_rng(0)
    out = {key: value.astype(np.float64) for key, value in arrays.items() if key != "part"}

    def across(axis):
        other = np.cross(axis, generator.normal(size=axis.shape))
        return other / np.linalg.norm(other, axis=-1, keepdims=True)

    def unit(shape):
        vector = generator.normal(size=shape)
        return vector / np.linalg.norm(vector, axis=-1, keepdims=True)

    pose, axis = out["camera_T_part"], out["joint_axis"]
    turn = Rotation.from_rotvec(np.radians(7) * unit((pose[..., 0, 0].size, 3))).as_matrix()
    pose[..., :3, :3] = pose[..., :3, :3] @ turn.reshape(pose[..., :3, :3].shape)
    pose[..., :3, 3] += 0.03 * unit((*pose.shape[:2], 3))
    tilt = Rotation.from_rotvec(np.radians(7) * across(axis).reshape(-1, 3))
    out["joint_pivot"] = out["joint_pivot"] + 0.03 * across(axis) + 0.4 * axis
    out["joint_axis"] = -5 * tilt.apply(axis.reshape(-1, 3)).reshape(axis.shape)
    return {"part": arrays["part"], **{k: v.astype(np.float32) for k, v in out.items()}}


def test_a_known_error_is_reported_as_such(split, tmp_path):
    arrays = perturbed(made.truth_as_prediction(split))
    turns = split.manifest.joints[0].kind == "revolute"
    # The axes point the other way, so do the states.
    more = np.float32(np.radians(7) if turns else 0.03)
    arrays["joint_state"] = -(arrays["joint_state"] + more)
    errors, report = score(split, arrays, tmp_path)
    np.testing.assert_allclose(errors["part_rotation", "deg"], 7, atol=1e-3)
    np.testing.assert_allclose(errors["part_translation", "m"], 0.03, atol=1e-6)
    np.testing.assert_allclose(errors["joint_direction", "deg"], 7, atol=1e-3)
    np.testing.assert_allclose(errors["joint_pivot", "m"], 0.03, atol=1e-6)
    state = errors["joint_state", "deg"] if turns else errors["joint_state", "m"]
    np.testing.assert_allclose(state, 7 if turns else 0.03, atol=1e-3 if turns else 1e-6)
    points = split.arrays("points")["points"].astype(np.float64)
    radius = np.linalg.norm(points - points.mean(1, keepdims=True), axis=-1).mean(1)
    for name in ("part_translation", "joint_pivot"):
        np.testing.assert_allclose(errors[name, "r4"], errors[name, "m"] / (4 * radius)[:, None],
                                   rtol=1e-5)  # fmt: skip
    precision = report["average_precision"]
    assert [precision[f"part_{k}"]["k"] for k in (5, 10, 15)] == [0, 11, 11]
    assert [precision[f"joint_{k}"]["k"] for k in (5, 10, 15)] == [0, 11, 11]


@pytest.mark.parametrize("settings", [
    Settings(iou="soft"), Settings(pivot="line-line"), Settings(rotation="folded"),
    Settings(label_order="dataset"), Settings(label_order="hungarian"),
    Settings(iou="soft", label_order="hungarian", rotation="folded"),
], ids=lambda settings: settings.changes())  # fmt: skip
def test_switches_equal_the_public_function(split, tmp_path, settings):
    generator = np.random.default_rng(3)
    arrays = perturbed(made.truth_as_prediction(split))
    del arrays["part"]
    parts = len(split.manifest.parts)
    weight = generator.dirichlet(np.full(parts, 0.3), size=(11, 48))
    arrays["part_weight"] = weight.astype(np.float32)
    errors, report = score(split, arrays, tmp_path, settings=settings)
    truth = split.arrays("part", "camera_T_part", "joint_pivot", "joint_axis")
    part = truth["part"].astype(np.int64)
    symmetry = categories.category(split.manifest.category).symmetry
    expected = sample_errors(
        part_true=np.where(part == 255, -1, part),
        camera_T_part_true=truth["camera_T_part"],
        pivot_true=truth["joint_pivot"], axis_true=truth["joint_axis"],
        part_pred=arrays["part_weight"], camera_T_part_pred=arrays["camera_T_part"],
        pivot_pred=arrays["joint_pivot"], axis_pred=arrays["joint_axis"],
        symmetry=None if symmetry is None else np.array(symmetry),
        label_order=settings.label_order, iou=settings.iou, pivot=settings.pivot,
        rotation=settings.rotation,
    )  # fmt: skip
    for (name, unit), value in errors.items():
        if name in expected and unit != "r4":
            np.testing.assert_allclose(value, expected[name], atol=1e-6, err_msg=name)
    assert report["variant"] == f"[{settings.changes()}]"


def test_the_csv_is_what_the_contract_says_and_the_same_bytes_twice(laptop, tmp_path):
    arrays = perturbed(made.truth_as_prediction(laptop))
    contents = []
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        score(laptop, arrays, folder)
        contents.append((folder / "s.csv.gz").read_bytes())
    assert contents[0] == contents[1]
    assert contents[0][4:8] == b"\0\0\0\0"  # gzip's time stamp
    text = gzip.decompress(contents[0]).decode()
    assert text.splitlines()[0] == ",".join(COLUMNS)
    frame = pd.read_csv(tmp_path / "a" / "s.csv.gz")
    assert len(frame) == 11 * (2 + 1 + 2 + 1 + 2 + 4 + 2)
    assert set(frame["unit"].astype(str)) == {"1", "deg", "r4", "m"}
    report = json.loads((tmp_path / "a" / "s.json").read_text())
    rows = frame[(frame["metric"] == "part_translation") & (frame["unit"] == "m")]
    mean = report["summary"]["part_translation_m"]
    assert mean["mean"] == pytest.approx(rows["value"].mean(), rel=1e-6)
    assert mean["low"] <= mean["mean"] <= mean["high"]
    assert report["digests"]["data"] == laptop.manifest.digest
    assert (report["commit"], report["machine"]) == (commit(), machine())
    assert len(report["instance"]) == 11


def test_precision_needs_all_its_metrics(laptop, tmp_path):
    errors, report = score(laptop, made.truth_as_prediction(laptop), tmp_path)
    counted = {name: int(passed.sum()) for name, passed in passes(errors, "mean").items()}
    assert counted == {k: v["k"] for k, v in report["average_precision"].items() if k != "rule"}
    del errors["joint_pivot", "m"]
    assert passes(errors, "mean") == {}


def test_blocks_do_not_change_the_scores(laptop, tmp_path, monkeypatch):
    arrays = perturbed(made.truth_as_prediction(laptop))
    whole, _ = score(laptop, arrays, tmp_path)
    monkeypatch.setattr("bench.scoring.truth.BLOCK", 2)
    monkeypatch.setattr("bench.scoring.truth.blocks.__defaults__", (2,))
    pieces, _ = score(laptop, arrays, tmp_path)
    for key, value in whole.items():
        np.testing.assert_array_equal(pieces[key], value)


def test_reconstruction_of_the_true_shape_is_zero(laptop, tmp_path):
    arrays = made.truth_as_prediction(laptop)
    truth = laptop.arrays("points", "part", "camera_T_part")
    pose = truth["camera_T_part"][np.arange(11)[:, None], truth["part"]].astype(np.float64)
    offset = truth["points"] - pose[..., :3, 3]
    own = np.einsum("bnji,bnj->bni", pose[..., :3, :3], offset)
    arrays["canonical_points"] = own.astype(np.float32)
    errors, _ = score(laptop, arrays, tmp_path)
    np.testing.assert_allclose(errors["reconstruction", "m"], 0, atol=1e-6)
    arrays["canonical_points"] = (own[:, :, :] + [0, 0, 10.0]).astype(np.float32)
    errors, _ = score(laptop, arrays, tmp_path)
    assert (errors["reconstruction", "m"] > 5).all()
    arrays["canonical_points"] = own.astype(np.float32)
    del arrays["camera_T_part"]
    errors, _ = score(laptop, arrays, tmp_path)
    assert np.isnan(errors["reconstruction", "m"]).all()


def test_labels_alone_leave_the_rest_empty(laptop, tmp_path):
    arrays = {"part": made.truth_as_prediction(laptop)["part"]}
    errors, report = score(laptop, arrays, tmp_path)
    np.testing.assert_array_equal(errors["iou", "1"], 1)
    for (name, _), value in errors.items():
        assert name in ("iou", "order") or np.isnan(value).all()
    assert report["summary"]["part_rotation_deg"]["mean"] is None
    assert set(report["average_precision"]) == {"rule", "seg_50", "seg_75"}
    assert report["average_precision"]["seg_75"]["k"] == 11


def test_who_never_gives_poses_has_no_precision_of_them_and_who_fails_once_has(laptop, tmp_path):
    arrays = made.truth_as_prediction(laptop)
    arrays["camera_T_part"][1:] = np.nan
    _, report = score(laptop, arrays, tmp_path)
    assert [report["average_precision"]["part_15"][name] for name in "kn"] == [1, 11]
    arrays["camera_T_part"][:] = np.nan
    _, report = score(laptop, arrays, tmp_path)
    assert "part_15" not in report["average_precision"]
    assert report["average_precision"]["joint_15"]["k"] == 11


def test_names_of_data(tmp_path):
    for folder, options, asked, expected in (
        ("plain", {}, "plain", "clean"),
        ("noisy", {"noise": "disparity"}, "noisy", "sensor"),
        ("set/sensor", {}, "set", "sensor"),
        ("set/clean", {}, "set/clean", "clean"),
        ("set/complete", {}, "set/complete", "complete"),
        ("named", {"benchmark": "sim-art/1/sensor"}, "named", "sim-art/1/sensor"),
    ):
        split = made.make_data(tmp_path / folder, "laptop", count=3, train=3, options=options)
        name = data_name(tmp_path / asked, split)
        assert name == f"{expected}@{split.manifest.digest[:12]}"


def test_the_digest_tells_two_benchmarks_apart(tmp_path):
    """`clean` and `sensor` both have laptops: the predictions say which were predicted."""
    for name, points in (("clean", 30), ("sensor", 40)):
        split = made.make_data(tmp_path / "set" / name, "laptop", count=4, points=points)
        path = made.write_truth(tmp_path / f"{name}.safetensors", split)
        train = Split(split.folder.parent / "train")
        calibration = made.write_truth(tmp_path / f"{name}-train.safetensors", train)
        report = evaluate(
            Request(
                predictions=path,
                data=tmp_path / "set",
                out=tmp_path / f"{name}.csv.gz",
                calibration=calibration,
            )
        )
        assert report["data"].startswith(f"{name}@")
        assert report["summary"]["iou_1"]["mean"] == 1
    other = made.write_truth(tmp_path / "o.safetensors", split, data_digest="2" * 64)
    with pytest.raises(StoreError, match="expected"):
        evaluate(Request(predictions=other, data=tmp_path / "set", out=tmp_path / "o.csv.gz"))


def test_a_changed_shard_is_refused(tmp_path):
    split = made.make_data(tmp_path / "data", "laptop", count=6)
    path = made.write_truth(tmp_path / "p.safetensors", split)
    shard = split.folder / split.manifest.shards[1].file
    data = bytearray(shard.read_bytes())
    data[-5] ^= 1
    shard.write_bytes(data)
    request = Request(predictions=path, data=tmp_path / "data", out=tmp_path / "s.csv.gz")
    with pytest.raises(StoreError, match=r"00001\.safetensors: expected sha256"):
        evaluate(request)


def run_program(*arguments):
    with pytest.raises(SystemExit) as ended:
        program.main([str(argument) for argument in arguments])
    return ended.value.code


def test_the_command(laptop, tmp_path, capsys):
    path = made.write_truth(tmp_path / "p.safetensors", laptop)
    out = tmp_path / "scores" / "made.csv.gz"
    program.main(["evaluate", "--predictions", str(path), "--data", str(root(laptop)), "--out",
                  str(out), "--ap-rule", "min", "--iou", "soft"])  # fmt: skip
    assert "No --calibration" in capsys.readouterr().out
    assert out.is_file()
    assert out.with_name("made.json").is_file()
    program.main(["tables", "--scores", str(out.parent), "--out", str(tmp_path / "tables")])
    assert (tmp_path / "tables" / "table1.md").is_file()
    bad = ("evaluate", "--predictions", path, "--data", tmp_path / "no", "--out", out)
    assert run_program(*bad) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("scapo-bench: ")
    assert run_program("evaluate", "--predictions", path, "--data", root(laptop), "--split", "val",
                       "--out", out) == 1  # fmt: skip
    assert "'split': expected 'val', found 'test': --split test?" in capsys.readouterr().err
    assert run_program(*bad[:-1], tmp_path / "scores.csv") == 1
    assert "expected a name that ends in .csv.gz" in capsys.readouterr().err
    for words in (["predict", "gone"], ["stability", "gone"], ["reference", "constant"]):
        kind = ["--category", "laptop"] if words[0] == "reference" else []
        assert run_program(*words, *kind, "--data", root(laptop), "--out", "p.txt") == 1
        assert "p.txt: expected a name that ends in ." in capsys.readouterr().err
    assert run_program("evaluate", "--prediction", path) == 2
    assert run_program("nothing") == 2
    assert run_program() == 2
    for verb in ([], *([name] for name in VERBS)):
        capsys.readouterr()
        assert run_program(*verb, "--help") == 0
        assert "usage: scapo-bench" in capsys.readouterr().out
