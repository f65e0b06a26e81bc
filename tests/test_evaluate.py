# SPDX-License-Identifier: MIT
"""From files to files: what `scapo-bench evaluate` does."""

from __future__ import annotations

import dataclasses
import gzip
import json

import made
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from bench import __main__ as program
from bench.evaluate import Request, data_name, evaluate
from bench.metrics import sample_errors
from bench.predictions import write_predictions
from bench.score_files import COLUMNS, read_scores
from bench.scores import Settings
from scapo import categories
from scapo.store import Split, StoreError, open_split

CATEGORIES = ("laptop", "eyeglasses", "drawer")


@pytest.fixture(scope="module", params=CATEGORIES)
def split(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    return made.make_data(folder, request.param, count=11, train=30, points=48, background=4)


@pytest.fixture(scope="module")
def laptop(tmp_path_factory):
    return made.make_data(tmp_path_factory.mktemp("data"), "laptop", count=11, train=30, points=48)


def root(split):
    return split.folder.parent.parent


def score(split, arrays, folder, calibration=None, settings=None, **header):
    """Write and evaluate; the scores as (metric, unit) -> (B, slots), and the report."""
    path, out = folder / "p.safetensors", folder / "s.csv.gz"
    write_predictions(path, made.header_of(split, **header), arrays)
    if calibration is not None:
        train = open_split(root(split), split.manifest.category, "train")
        write_predictions(folder / "c.safetensors", made.header_of(train, **header), calibration)
    report = evaluate(Request(
        predictions=path, data=root(split), out=out, settings=settings or Settings(),
        calibration=None if calibration is None else folder / "c.safetensors",
    ))  # fmt: skip
    (scores,) = read_scores(out)
    return scores.errors, report


def lengths(errors):
    return {key: value for key, value in errors.items() if key[1] in ("m", "r4")}


def test_the_truth_scores_one_and_zero(split, tmp_path):
    for supervision in ((), ("pose", "segmentation", "joint")):
        errors, report = score(split, made.truth_as_prediction(split), tmp_path,
                               supervision=supervision)  # fmt: skip
        for (name, unit), value in errors.items():
            expected = 1 if name == "iou" else 0
            np.testing.assert_allclose(value, expected, atol=1e-6, err_msg=f"{name} {unit}")
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


def own_frames(split, seed):
    """The truth in hidden canonical frames and states, parts swapped in some samples where the
    category's symmetry makes that the same object."""
    generator = np.random.default_rng(seed)
    arrays = made.truth_as_prediction(split)
    category = categories.category(split.manifest.category)
    parts = len(category.parts)
    hidden = np.random.default_rng(42)
    frames = np.tile(np.eye(4), (parts, 1, 1))
    frames[:, :3, :3] = Rotation.random(parts, random_state=42).as_matrix()
    frames[:, :3, 3] = hidden.normal(scale=0.2, size=(parts, 3))
    points = split.arrays("points")["points"].astype(np.float64)
    scale = 4 * np.linalg.norm(points - points.mean(1, keepdims=True), axis=-1).mean(1)
    pose = arrays["camera_T_part"].astype(np.float64)
    part = arrays["part"].astype(np.int64)
    if category.symmetry is not None:
        swapped = generator.random(len(part)) < 0.4
        order = np.array([1, 0] if parts == 2 else [0, 2, 1])
        turn = np.eye(4)
        turn[:3, :3] = category.symmetry
        pose[swapped] = pose[swapped][:, order] @ turn
        known = part[swapped] != 255
        part[swapped] = np.where(known, order[np.where(known, part[swapped], 0)], 255)
        if parts == 3:
            for name in ("joint_pivot", "joint_axis", "joint_state"):
                arrays[name][swapped] = arrays[name][swapped][:, ::-1]
        else:  # the child is the true base: it moves the other way
            arrays["joint_axis"][swapped] *= -1
    metric = np.broadcast_to(frames, pose.shape).copy()
    metric[..., :3, 3] *= scale[:, None, None]
    pose = pose @ np.linalg.inv(metric)
    turns = np.array([joint.kind == "revolute" for joint in category.joints])
    shift = np.where(turns, 0.7, 0.3 * scale[:, None])
    state = arrays["joint_state"] + shift
    flipped = generator.random(len(part)) < 0.5  # an axis may point either way
    arrays["joint_axis"][flipped] *= -1
    state[flipped] *= -1
    return arrays | {
        "part": part.astype(np.uint8),
        "camera_T_part": pose.astype(np.float32),
        "joint_state": state.astype(np.float32),
    }


def test_calibration_finds_hidden_frames_and_states(split, tmp_path):
    train = Split(root(split) / split.manifest.category / "train")
    calibration = own_frames(train, 1)
    generator = np.random.default_rng(0)
    calibration["camera_T_part"][:6, :, :3, :3] = (
        Rotation.random(6, random_state=0).as_matrix()[:, None]
    )  # fmt: skip
    del generator
    calibration["camera_T_part"][6] = np.nan
    arrays = own_frames(split, 2)
    errors, report = score(split, arrays, tmp_path, calibration)
    np.testing.assert_array_equal(errors["iou", "1"], 1)
    np.testing.assert_allclose(errors["part_rotation", "deg"], 0, atol=1e-3)
    np.testing.assert_allclose(errors["part_translation", "r4"], 0, atol=1e-5)
    for key, value in errors.items():
        if key[0] == "joint_state":
            np.testing.assert_allclose(value, 0, atol=1e-3)
    found = report["calibration"]
    assert found["samples"] == 30
    assert found["answered"] == [29] * len(split.manifest.parts)
    assert min(found["rotation_inlier_ratio"]) >= 23 / 29 - 1e-9
    uncalibrated, _ = score(split, arrays, tmp_path)
    assert uncalibrated["part_rotation", "deg"].mean() > 20


def test_calibration_on_tested_or_foreign_predictions_is_refused(laptop, tmp_path):
    path = made.write_truth(tmp_path / "p.safetensors", laptop)
    train = Split(root(laptop) / "laptop" / "train")
    request = Request(predictions=path, data=root(laptop), out=tmp_path / "s.csv.gz",
                      calibration=path)  # fmt: skip
    with pytest.raises(StoreError, match=r"expected predictions on the split 'train' for "
                                         r"calibration, found split 'test'"):  # fmt: skip
        evaluate(request)
    # A header that claims the training split, over the tested data.
    sly = tmp_path / "sly.safetensors"
    write_predictions(sly, made.header_of(laptop, split="train"),
                      made.truth_as_prediction(laptop))  # fmt: skip
    with pytest.raises(StoreError, match="for calibration, found split 'train' with data digest"):
        evaluate(dataclasses.replace(request, calibration=sly))
    for field, value in (("method", "other"), ("variant", "v2"), ("seed", 2)):
        other = made.write_truth(tmp_path / "o.safetensors", train, **{field: value})
        with pytest.raises(StoreError, match=f"header field '{field}': expected"):
            evaluate(dataclasses.replace(request, calibration=other))
    foreign = made.write_truth(tmp_path / "f.safetensors", train, data_digest="1" * 64)
    with pytest.raises(StoreError, match="header field 'data_digest': expected"):
        evaluate(dataclasses.replace(request, calibration=foreign))


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
    assert len(frame) == 11 * (2 + 1 + 2 + 1 + 2 + 4)
    assert set(frame["unit"].astype(str)) == {"1", "deg", "r4", "m"}
    report = json.loads((tmp_path / "a" / "s.json").read_text())
    rows = frame[(frame["metric"] == "part_translation") & (frame["unit"] == "m")]
    mean = report["summary"]["part_translation_m"]
    assert mean["mean"] == pytest.approx(rows["value"].mean(), rel=1e-6)
    assert mean["low"] <= mean["mean"] <= mean["high"]
    assert report["digests"]["data"] == laptop.manifest.digest
    assert len(report["instance"]) == 11


def test_blocks_do_not_change_the_scores(laptop, tmp_path, monkeypatch):
    arrays = perturbed(made.truth_as_prediction(laptop))
    whole, _ = score(laptop, arrays, tmp_path)
    monkeypatch.setattr("bench.truth.BLOCK", 2)
    monkeypatch.setattr("bench.truth.blocks.__defaults__", (2,))
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
        assert name == "iou" or np.isnan(value).all()
    assert report["summary"]["part_rotation_deg"]["mean"] is None
    assert report["average_precision"]["part_15"] == {"k": 0, "n": 11, "low": 0.0, "high": 0.0}


def test_compat_needs_its_record(laptop, tmp_path):
    settings = Settings(geometry="opalign-compat")
    names = "record_R_select, record_T_select, record_S_joint"
    with pytest.raises(StoreError, match=f"expected the tensors {names}.*, found none"):
        score(laptop, made.truth_as_prediction(laptop), tmp_path, settings=settings)


def network_record(split):
    """A perfect OP-Align network: identity global rotation, canonical shape at its own states."""
    arrays = split.arrays("points", "joint_pivot", "joint_axis", "joint_state")
    points = arrays["points"].astype(np.float64)
    centre = points.mean(1)
    expand = 0.25 / np.linalg.norm(points - centre[:, None], axis=-1).mean(1)
    count, joints = arrays["joint_state"].shape
    pivot = (arrays["joint_pivot"] - centre[:, None]) * expand[:, None, None]
    tilt = arrays["joint_axis"] + 0.05 * np.roll(arrays["joint_axis"], 1, -1)
    angle = np.zeros((count, joints, 2))
    angle[..., 1] = arrays["joint_state"]
    return {f"record_{name}": value.astype(np.float32) for name, value in {
        "R_select": np.tile(np.eye(3), (count, 1, 1)), "T_select": np.zeros((count, 3)),
        "S_joint": pivot, "S_drct": arrays["joint_axis"], "S_angl": angle,
        "I_joint": pivot, "I_drct": tilt, "I_angl": np.zeros_like(angle),
    }.items()}  # fmt: skip


def test_compat_through_files_equals_the_function(laptop, tmp_path):
    from bench.compat import opalign

    train = Split(root(laptop) / "laptop" / "train")
    settings = Settings(geometry="opalign-compat")
    arrays = made.truth_as_prediction(laptop) | network_record(laptop)
    calibration = made.truth_as_prediction(train) | network_record(train)
    with pytest.raises(StoreError, match="expected --calibration"):
        score(laptop, arrays, tmp_path, settings=settings)
    errors, report = score(laptop, arrays, tmp_path, calibration, settings)
    record = {"shape_type": "none", "n_train": 30, "ransac_seed": 1234,
              "symmetry": np.diag([1, -1, -1])}  # fmt: skip
    scales = []
    for rows in (train, laptop):
        raw = rows.arrays("points", "part", "camera_T_part", "joint_pivot", "joint_axis")
        points = raw["points"].astype(np.float64)
        centre = points.mean(1)
        expand = 0.25 / np.linalg.norm(points - centre[:, None], axis=-1).mean(1)
        pose = raw["camera_T_part"].astype(np.float64)
        pose[..., :3, 3] = (pose[..., :3, 3] - centre[:, None]) * expand[:, None, None]
        pivot = (raw["joint_pivot"] - centre[:, None]) * expand[:, None, None]
        joint = np.concatenate([pivot, raw["joint_axis"]], -1)
        one_hot = np.moveaxis(np.eye(2)[raw["part"]], -1, 1)
        for name, value in (("gt_pose", pose), ("gt_joint", joint), ("pred_seg", one_hot),
                            ("gt_seg", raw["part"].astype(np.int64))):  # fmt: skip
            record.setdefault(name, []).append(value)
        for name, value in network_record(rows).items():
            record.setdefault(name.removeprefix("record_"), []).append(value)
        scales.append(1 / expand)
    joined = {k: np.concatenate(v) if isinstance(v, list) else v for k, v in record.items()}
    expected = opalign(joined)
    np.testing.assert_allclose(errors["part_rotation", "deg"], expected["rot_err_deg"], atol=1e-3)
    np.testing.assert_allclose(errors["part_translation", "r4"], expected["trans_err"], atol=1e-5)
    np.testing.assert_allclose(errors["joint_pivot", "r4"], expected["pivot_err"], atol=1e-5)
    assert report["calibration"]["opalign"]["seed"] == 1234
    metres = expected["trans_err"] * scales[1][:, None]
    np.testing.assert_allclose(errors["part_translation", "m"], metres, atol=1e-5)


def test_names_of_data(tmp_path):
    for folder, options, asked, expected in (
        ("plain", {}, "plain", "clean"),
        ("noisy", {"noise": "disparity"}, "noisy", "sensor"),
        ("set/sensor", {}, "set", "sensor"),
        ("set/clean", {}, "set/clean", "clean"),
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
    assert run_program(*bad[:-1], tmp_path / "scores.csv") == 1
    assert "expected a name that ends in .csv.gz" in capsys.readouterr().err
    assert run_program("evaluate", "--prediction", path) == 2
    assert run_program("nothing") == 2
    assert run_program() == 2
    for verb in ([], ["evaluate"], ["tables"]):
        capsys.readouterr()
        assert run_program(*verb, "--help") == 0
        assert "usage: scapo-bench" in capsys.readouterr().out
