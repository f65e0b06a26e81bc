# SPDX-License-Identifier: MIT
"""Calibration through files, and the published evaluator on files."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bench.compat.readings import opalign
from bench.requests import Request, Settings
from bench.scoring.compat_files import check_record
from bench.scoring.evaluate import evaluate
from scapo import categories
from scapo.store import Split, StoreError
from scapo.store.predictions import write_predictions
from tests.helpers import made
from tests.helpers.scoring import root, score


def own_frames(split, seed):
    """The truth in hidden canonical frames and states, parts swapped in some samples where the
    category's symmetry makes that the same object."""
    generator = np.random.default_rng(seed)
    arrays = made.truth_as_prediction(split)
    category = categories.category(split.manifest.category)
    parts = len(category.parts)
    hidden = np.random.default_rng(42)
    frames = np.tile(np.eye(4), (parts, 1, 1))
    frames[:, :3, :3] = made.rotations(hidden, parts)
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
        made.rotations(generator, 6)[:, None]
    )  # fmt: skip
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


def test_real_objects_are_calibrated_on_the_training_split_of_another_part(tmp_path):
    made.make_data(tmp_path / "complete", "laptop", train=20, points=48)  # nobody's
    test = made.make_data(tmp_path / "clean", "laptop", count=11, train=30, points=48)
    train = Split(root(test) / "laptop" / "train")
    arrays = made.sample_arrays("laptop", 9, 48, seed=7)
    real = made.write_split(tmp_path / "real", "laptop", "test", arrays)
    paths = [tmp_path / "r.safetensors", tmp_path / "c.safetensors"]
    for path, split, seed in zip(paths, (real, train), (2, 1), strict=True):
        write_predictions(path, made.header_of(split), own_frames(split, seed))
    request = Request(predictions=paths[0], data=tmp_path / "real", out=tmp_path / "s.csv.gz",
                      calibration=paths[1])  # fmt: skip
    report = evaluate(request)
    assert report["calibration"]["data"] == train.manifest.digest
    assert report["summary"]["part_rotation_deg"]["mean"] == pytest.approx(0, abs=1e-3)
    assert evaluate(dataclasses.replace(request, data=tmp_path))["summary"] == report["summary"]
    (tmp_path / "real").rename(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "deeper").mkdir()
    (tmp_path / "elsewhere" / "laptop").rename(tmp_path / "elsewhere" / "deeper" / "laptop")
    (tmp_path / "real").symlink_to(tmp_path / "elsewhere" / "deeper")  # beside the link, not it
    assert evaluate(request)["summary"] == report["summary"]
    train.folder.rename(tmp_path / "gone")
    with pytest.raises(StoreError, match="train"):
        evaluate(request)


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
    with pytest.raises(StoreError, match="other clouds than those that are scored"):
        evaluate(dataclasses.replace(request, calibration=sly))
    for field, value in (("method", "other"), ("variant", "v2"), ("seed", 2)):
        other = made.write_truth(tmp_path / "o.safetensors", train, **{field: value})
        with pytest.raises(StoreError, match=f"header field '{field}': expected"):
            evaluate(dataclasses.replace(request, calibration=other))
    foreign = made.write_truth(tmp_path / "f.safetensors", train, data_digest="1" * 64)
    with pytest.raises(StoreError, match="header field 'data_digest': expected"):
        evaluate(dataclasses.replace(request, calibration=foreign))


def test_compat_needs_its_record(laptop, tmp_path):
    settings = Settings(geometry="opalign-compat")
    names = "record_R_select, record_T_select, record_S_joint"
    with pytest.raises(StoreError, match=f"expected the tensors {names}.*, found none"):
        score(laptop, made.truth_as_prediction(laptop), tmp_path, settings=settings)


def test_the_message_names_what_is_missing(tmp_path):
    names = ("record_R_select", "record_S_joint", "part")
    with pytest.raises(StoreError, match=r"p: expected the tensors record_T_select, record_S_drct"):
        check_record(tmp_path / "p", names)


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
