# SPDX-License-Identifier: MIT
from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bench.metrics import average_precision


def precision_inputs(seed=0, count=200, parts=2) -> dict[str, Any]:
    generator = np.random.default_rng(seed)
    return {
        "iou": generator.uniform(0.4, 1, size=(count, parts)),
        "part_rotation": generator.gamma(2, 4, size=(count, parts)),
        "part_translation": generator.gamma(2, 0.03, size=(count, parts)),
        "joint_direction": generator.gamma(2, 3, size=(count, parts - 1)),
        "joint_pivot": generator.gamma(2, 0.03, size=(count, parts - 1)),
    }


@pytest.mark.parametrize("rule", ["mean", "min", "per-part"])
def test_precision_counts_samples_one_by_one(rule):
    values = precision_inputs(parts=3)
    found = average_precision(**values, rule=rule)
    join = {"mean": np.mean, "min": np.max, "per-part": list}[rule]
    for k in (5, 10, 15):
        for name, angle, length in (("joint", "joint_direction", "joint_pivot"),
                                    ("part", "part_rotation", "part_translation")):  # fmt: skip
            passed = [a < k and t < k / 100
                      for a_row, t_row in zip(values[angle], values[length], strict=True)
                      for a, t in zip(np.atleast_1d(join(a_row)), np.atleast_1d(join(t_row)),
                                      strict=True)]  # fmt: skip
            assert found[f"{name}_{k}"] == pytest.approx(sum(passed) / len(passed))
    assert found["seg_75"] <= found["seg_50"]
    assert found["part_5"] <= found["part_10"] <= found["part_15"]


def test_precision_is_strict_and_undefined_fails():
    values: dict[str, Any] = {
        "iou": np.array([[0.75, 0.75], [0.76, np.nan], [np.nan, np.nan]]),
        "part_rotation": np.array([[5.0, 5.0], [4.9, np.nan], [4.9, 4.9]]),
        "part_translation": np.array([[0.01] * 2] * 3),
        "joint_direction": np.array([[1.0], [1.0], [np.nan]]),
        "joint_pivot": np.array([[0.05], [0.0499], [0.0]]),
    }
    found = average_precision(**values)
    assert found["seg_75"] == pytest.approx(1 / 3)
    assert found["part_5"] == pytest.approx(1 / 3)
    assert found["joint_5"] == pytest.approx(1 / 3)
    assert average_precision(**values, rule="per-part")["part_5"] == pytest.approx(3 / 6)
    with pytest.raises(ValueError, match="rule: expected mean, min or per-part, found 'max'"):
        average_precision(**values, rule="max")


def test_precision_of_fixtures(shared_dir):
    archive = np.load(shared_dir / "fixtures" / "metric_fixtures.npz")
    for case in {key.split("/")[0] for key in archive.files if key.startswith("ap_")}:
        given_ = {
            name: archive[f"{case}/in/{name}"]
            for name in ("iou", "rot_err_deg", "trans_err_dm", "dir_err_deg", "pivot_err_dm")
        }
        for rule in ("mean", "min", "per_part"):
            found = average_precision(
                iou=given_["iou"], part_rotation=given_["rot_err_deg"],
                part_translation=given_["trans_err_dm"] / 10,
                joint_direction=given_["dir_err_deg"], joint_pivot=given_["pivot_err_dm"] / 10,
                rule=rule,
            )  # fmt: skip
            for name, value in found.items():
                assert value == pytest.approx(float(archive[f"{case}/out/{rule}_{name}"]))
