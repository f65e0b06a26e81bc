# SPDX-License-Identifier: MIT
"""Probabilities: fitted as they were drawn, monotone, judged by counting, stored and refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from bench.infer.calibration import (
    Calibration,
    LogisticMap,
    calibration_file,
    feature,
    fit_map,
    read_calibration,
    reliability,
    with_confidence,
    write_calibration,
)
from bench.twin.record import Twin
from scapo.alignment import Alignment
from scapo.categories import CATEGORIES
from scapo.store.schema import StoreError
from tests.helpers.conventions import CLOUDS

OVEN = CATEGORIES["oven"]
EVIDENCE = {"residual": 0.3, "margin": 0.2, "joint_0_spread": 2.0, "part_0_spread": 1.0,
            "part_1_spread": 3.0}  # fmt: skip


def calibration() -> Calibration:
    one = LogisticMap(bias=0.5, weight=(-1.0, 2.0, -0.5))
    return Calibration(
        model="a" * 64, mode="quick", category="oven", split="val", data="d", samples=30,
        alignment=Alignment.of_order((0, 1), CLOUDS),
        joint=(one,), part=(one, replace(one, bias=-1.0)),
        reliability={"joint": reliability(np.array([0.25, 0.8]), np.array([False, True]))},
    )  # fmt: skip


def twin(evidence: dict[str, float]) -> Twin:
    return Twin(
        name="a", category=OVEN, points=np.zeros((2, 3)), part=np.zeros(2, int),
        camera_T_part=np.eye(4)[None].repeat(2, 0), pivot=np.zeros((1, 3)), axis=np.eye(3)[:1],
        state=np.zeros(1), limits=np.array([[0, 1.0]]), evidence=evidence,
    )  # fmt: skip


def test_the_map_that_outcomes_were_drawn_from_is_found():
    rng = np.random.default_rng(0)
    x = np.stack([rng.normal(size=4000), rng.uniform(0, 1, 4000), rng.gamma(1.0, size=4000)], 1)
    true = LogisticMap(bias=0.3, weight=(-1.5, 2.0, -0.8))
    right = rng.uniform(size=4000) < [true.probability(row) for row in x.tolist()]
    found = fit_map(x, right)
    told = np.array([found.probability(row) for row in x.tolist()])
    wanted = np.array([true.probability(row) for row in x.tolist()])
    assert np.abs(told - wanted).max() < 0.06
    assert reliability(told, right).error < 0.03


def test_nothing_speaks_the_wrong_way_and_a_method_never_wrong_stays_finite():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(200, 3))
    against = fit_map(x, x @ [1.0, -1.0, 1.0] > 0)  # the opposite of what could be
    assert against.weight == pytest.approx((0, 0, 0), abs=1e-6)
    always = fit_map(x, np.ones(200, bool))
    assert 0.9 < always.probability(x[0].tolist()) < 1


def test_reliability_counts():
    probability = np.array([0.05, 0.02, 0.95, 0.92, 0.98, 1.0])
    right = np.array([False, True, True, True, False, True])
    found = reliability(probability, right)
    assert found.count == (2, 0, 0, 0, 0, 0, 0, 0, 0, 4)
    assert found.predicted[0] == pytest.approx(0.035)
    assert found.right[9] == 0.75
    assert found.error == pytest.approx((2 * abs(0.035 - 0.5) + 4 * abs(0.9625 - 0.75)) / 6)
    assert found.brier == pytest.approx(np.square(probability - right).mean())
    assert found.base_rate == pytest.approx(4 / 6)


def test_a_twin_gets_probabilities_or_the_reason_why_not():
    sure, reason = with_confidence(twin(EVIDENCE), calibration())
    assert reason is None
    assert sure.joint_confidence is not None
    assert sure.part_confidence is not None
    score = 0.5 - np.log(0.3) + 2 * 0.2 - 0.5 * np.log(3.0)
    assert sure.joint_confidence[0] == pytest.approx(1 / (1 + np.exp(-score)))
    assert sure.part_confidence[0] > sure.part_confidence[1]
    _, reason = with_confidence(twin(EVIDENCE), None)
    assert reason is not None
    assert "scapo-bench calibrate" in reason
    unsure, reason = with_confidence(twin({"margin": 0.2}), calibration())
    assert unsure.joint_confidence is None
    assert reason == "the method has no shape to compare with the view"
    assert feature({"margin": 1.0}, "joint", 0) is None


def test_it_is_read_as_written_and_belongs_to_one_checkpoint(tmp_path):
    path = calibration_file(tmp_path / "checkpoint.safetensors", "quick")
    assert path.name == "checkpoint.calibration-quick.json"
    write_calibration(path, calibration())
    assert read_calibration(path, "a" * 64) == calibration()
    with pytest.raises(StoreError, match="found that of aaaaaaaaaaaa: scapo-bench calibrate"):
        read_calibration(path, "b" * 64)
    path.write_text("{}")
    with pytest.raises(StoreError, match="expected scapo-calibration/2"):
        read_calibration(path, "a" * 64)


def test_files_of_before_are_read_their_one_offset_for_every_part(tmp_path):
    path = calibration_file(tmp_path / "checkpoint.safetensors", "quick")
    write_calibration(path, calibration())
    record = json.loads(path.read_text())
    base = np.eye(4)
    base[:3, 3] = [0.1, 0.2, 0.3]
    record["format"] = "scapo-calibration/1"
    record["alignment"] = {"order": [1, 0], "base": base.tolist(), "sign": [-1.0], "zero": [0.5]}
    path.write_text(json.dumps(record))
    found = read_calibration(path, "a" * 64)
    assert found.alignment is not None
    assert (found.alignment.order, found.alignment.sign) == ((1, 0), (-1.0,))
    np.testing.assert_array_equal(found.alignment.own_T_part, [base, base])
    assert found.alignment.clouds.samples == 30
    record["alignment"] = {"order": 3}
    path.write_text(json.dumps(record))
    with pytest.raises(StoreError, match="alignment"):
        read_calibration(path, "a" * 64)
