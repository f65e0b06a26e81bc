# SPDX-License-Identifier: MIT
"""Every kind of damage to a predictions file is refused with one line, and none crashes."""

from __future__ import annotations

import csv
import gzip

import numpy as np
import pytest

from bench.requests import Request
from bench.scoring.evaluate import evaluate
from scapo.store import StoreError
from scapo.store.predictions import (
    WEIGHT_TOLERANCE,
    Predictions,
    check_rows,
    read_prediction_header,
)
from tests.helpers import made
from tests.helpers.damaged import DAMAGE, file_bytes, header_json


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    return made.make_data(tmp_path_factory.mktemp("data"), "eyeglasses", count=7, points=24)


def test_there_are_enough_kinds():
    assert len(DAMAGE) >= 40


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_refused_in_one_line(kind, split, tmp_path):
    path = tmp_path / "predictions.safetensors"
    path.write_bytes(DAMAGE[kind](split, made.truth_as_prediction(split)))
    request = Request(predictions=path, data=split.folder.parent.parent, out=tmp_path / "s.csv.gz")
    with pytest.raises(StoreError) as caught:
        evaluate(request)
    line = str(caught.value)
    assert "\n" not in line
    assert "expected" in line
    assert "found" in line
    assert str(path) in line or "teapot" in line or "laptop" in line
    assert [item.name for item in tmp_path.iterdir()] == [path.name]  # nothing half-written


def test_random_flips_of_bytes_never_crash(split, tmp_path):
    """Whatever a disk does: a clear refusal, or a file whose every value is still possible."""
    generator = np.random.default_rng(0)
    good = file_bytes(made.truth_as_prediction(split), header_json(split))
    path = tmp_path / "predictions.safetensors"
    refused = 0
    for _ in range(150):
        data = bytearray(good)
        for place in generator.integers(0, len(good), size=3):
            data[place] ^= int(generator.integers(1, 256))
        path.write_bytes(data)
        try:
            with Predictions(path, split) as predictions:
                predictions.rows(0, split.manifest.count)
                predictions.finish()
        except StoreError as error:
            assert "expected" in str(error)  # noqa: PT017
            refused += 1
    assert refused > 50


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_weights_may_be_off_by_the_tolerance(dtype):
    tolerance = WEIGHT_TOLERANCE[np.dtype(dtype)]
    good = np.full((1, 4, 2), 0.5 + 0.4 * tolerance, dtype)
    assert check_rows("here", "part_weight", good, 0, 2)[1] == 0
    with pytest.raises(StoreError, match="here: sample 7: expected weights of a point to sum"):
        check_rows("here", "part_weight", good + dtype(0.3 * tolerance), 7, 2)


def test_messages_name_file_tensor_expected_and_found(split, tmp_path):
    path = tmp_path / "p.safetensors"
    arrays = made.truth_as_prediction(split)
    arrays["joint_axis"] = arrays["joint_axis"][:, :1]
    path.write_bytes(file_bytes(arrays, header_json(split)))
    with pytest.raises(StoreError, match=r"p\.safetensors: tensor 'joint_axis': expected shape "
                                         r"\(7, 2, 3\), found \(7, 1, 3\)"):  # fmt: skip
        Predictions(path, split)


def test_a_row_of_nan_is_no_answer(split, tmp_path):
    arrays = made.truth_as_prediction(split, weights=True)
    for name in arrays:
        arrays[name][2] = np.nan
    arrays["joint_axis"][3, 0] = 0  # an axis of no length is allowed: its error is empty
    path = tmp_path / "p.safetensors"
    path.write_bytes(file_bytes(arrays, header_json(split)))
    request = Request(predictions=path, data=split.folder.parent.parent, out=tmp_path / "s.csv.gz")
    report = evaluate(request)
    assert report["counts"]["unanswered"] == dict.fromkeys(sorted(arrays), 1)
    undefined = {name: row["undefined"] for name, row in report["summary"].items()}
    assert undefined["iou_1"] == 3
    assert undefined["joint_direction_deg"] == 3
    assert undefined["joint_pivot_m"] == 2
    assert undefined["part_rotation_deg"] == 3
    assert report["average_precision"]["seg_50"]["k"] == 6
    assert report["average_precision"]["seg_50"]["n"] == 7


LOST = {
    ("camera_T_part", (1, 2)): {"part_rotation_deg": 1, "part_translation_m": 1},
    ("camera_T_part", (1, 2, 0, 3)): {"part_rotation_deg": 1, "part_translation_m": 1},
    ("joint_pivot", (0, 0, 1)): {"joint_pivot_m": 1},
    ("joint_axis", (0, 0, 1)): {"joint_direction_deg": 1},
    ("joint_state", (2, 0)): {"joint_state_deg": 1},
}
"""Where one NaN stands, or a whole slot of them -> values that the scores lack."""


@pytest.mark.parametrize(("name", "place"), LOST)
def test_a_missing_slot_costs_its_own_scores_alone(name, place, split, tmp_path):
    """The other slots keep their errors of zero, and nothing missing counts as one."""
    arrays = made.truth_as_prediction(split)
    arrays[name] = arrays[name].copy()
    arrays[name][place] = np.nan
    path = tmp_path / "p.safetensors"
    path.write_bytes(file_bytes(arrays, header_json(split)))
    request = Request(predictions=path, data=split.folder.parent.parent, out=tmp_path / "s.csv.gz")
    report = evaluate(request)
    summary, precision = report["summary"], report["average_precision"]
    undefined = {key: row["undefined"] for key, row in summary.items() if row["undefined"]}
    lost = LOST[name, place]
    assert {key: n for key, n in undefined.items() if not key.endswith("_r4")} == lost
    assert all(summary[key]["mean"] < 0.1 for key in lost)
    # A table tells of such samples: who leaves out what is hard has the better mean.
    assert report["counts"]["unanswered"] == dict.fromkeys(sorted(arrays), 0) | {name: 1}
    kind = "part" if name == "camera_T_part" else "joint"
    assert precision[f"{kind}_15"]["k"] == (7 if name == "joint_state" else 6)
    with gzip.open(request.out, "rt") as file:
        rows = [row for row in csv.DictReader(file) if row["value"] == ""]
    assert {(row["sample"], row["slot"]) for row in rows} == {(str(place[0]), str(place[1]))}


@pytest.mark.parametrize(
    ("name", "metric"),
    [
        ("part_weight", "iou_1"),
        ("camera_T_part", "part_rotation_deg"),
        ("joint_axis", "joint_direction_deg"),
        ("joint_state", "joint_state_deg"),
    ],
)
def test_a_tensor_that_answers_nothing_leaves_the_others_scored(name, metric, split, tmp_path):
    arrays = made.truth_as_prediction(split, weights=True)
    arrays[name] = np.full_like(arrays[name], np.nan)
    path = tmp_path / "p.safetensors"
    path.write_bytes(file_bytes(arrays, header_json(split)))
    request = Request(predictions=path, data=split.folder.parent.parent, out=tmp_path / "s.csv.gz")
    report = evaluate(request)
    assert report["counts"]["unanswered"] == dict.fromkeys(sorted(arrays), 0) | {name: 7}
    assert report["summary"][metric]["count"] == 0
    assert report["summary"]["joint_pivot_m"]["count"] == 14


def test_half_a_slot_comes_back_as_none():
    poses = np.tile(np.eye(4, dtype=np.float32), (2, 3, 1, 1))
    poses[1, 2, 0, 3] = np.nan
    found, missing = check_rows("here", "camera_T_part", poses, 0, 3)
    assert np.isnan(found[1, 2]).all()
    assert np.isfinite(found[1, :2]).all()
    assert missing == 1


@pytest.mark.parametrize("key", ["data_digest", "digest", "data"])
def test_the_digest_has_three_names(split, tmp_path, key):
    record = header_json(split, data_digest=...) | {key: split.manifest.digest}
    path = tmp_path / "p.safetensors"
    path.write_bytes(file_bytes(made.truth_as_prediction(split), record))
    assert read_prediction_header(path).data_digest == split.manifest.digest


def test_a_missing_file(split, tmp_path):
    with pytest.raises(StoreError, match="expected a file, found none; `scapo-bench predict"):
        Predictions(tmp_path / "none.safetensors", split)


def test_half_precision_weights_and_axes_of_any_length(split, tmp_path):
    arrays = made.truth_as_prediction(split, weights=True)
    generator = np.random.default_rng(0)
    soft = generator.dirichlet(np.ones(3), size=arrays["part_weight"].shape[:2])
    arrays["part_weight"] = soft.astype(np.float16)
    arrays["joint_axis"] *= -7
    path = tmp_path / "p.safetensors"
    path.write_bytes(file_bytes(arrays, header_json(split)))
    with Predictions(path, split) as predictions:
        assert predictions.names == tuple(sorted(arrays))
        predictions.rows(0, 7)
        predictions.finish()
