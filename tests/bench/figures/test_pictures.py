# SPDX-License-Identifier: MIT
"""Pictures hold what they claim: parts in their colours, axes where the joints are."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from bench.figures.pictures import hard_parts, predictions_picture, training_curve
from scapo import store
from scapo.drawing import BACKGROUND, PART_COLORS, draw_axis, draw_cloud
from tests.helpers.splits import write_split

CLOUD = np.array([[0.0, 0.0, 2.0], [0.2, 0.0, 2.0], [0.0, 0.4, 1.0], [0.1, 0.1, 4.0]])


def color_count(path: Path, color: str) -> int:
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    distance = np.abs(pixels - np.round(255 * np.array(to_rgb(color)))).max(-1)
    return int((distance < 30).sum())


def test_draw_cloud_projects_far_points_first_in_their_colours() -> None:
    axes = Figure().subplots()
    draw_cloud(axes, CLOUD, np.array([0, 1, -1, 0]))
    drawn = axes.collections[0]
    expected = (CLOUD[:, :2] / CLOUD[:, 2:])[[3, 0, 1, 2]]
    np.testing.assert_allclose(np.asarray(drawn.get_offsets()), expected)
    colors = [to_rgb(name) for name in (PART_COLORS[0], PART_COLORS[0], PART_COLORS[1], BACKGROUND)]
    np.testing.assert_allclose(np.asarray(drawn.get_facecolor())[:, :3], colors)
    assert axes.yaxis_inverted()  # y down, as the camera sees it


def test_draw_axis_lies_on_the_projected_line() -> None:
    axes = Figure().subplots()
    pivot, axis = np.array([0.1, 0.0, 2.0]), np.array([0.0, 3.0, 0.0])
    draw_axis(axes, CLOUD, pivot, axis, color="red")
    ends = np.asarray(axes.lines[-1].get_xydata())
    np.testing.assert_allclose(ends[:, 0], 0.05)
    assert np.ptp(ends[:, 1]) > 0.1


def test_draw_axis_leaves_out_lines_behind_the_camera() -> None:
    axes = Figure().subplots()
    draw_axis(axes, CLOUD, np.array([0.0, 0.0, -5.0]), np.array([1.0, 0, 0]), color="red")
    assert not axes.lines


def test_hard_parts_of_weights_and_of_labels() -> None:
    weight = np.array([[[0.2, 0.8], [0.9, 0.1]]])
    assert hard_parts({"part_weight": weight}).tolist() == [[1, 0]]
    assert hard_parts({"part": np.array([[1, 0]], np.uint8)}).tolist() == [[1, 0]]


def test_predictions_picture_colours_both_parts_and_the_predicted_axis(tmp_path: Path) -> None:
    folder = write_split(tmp_path / "data")
    split = store.Split(folder)
    truth = split.arrays("points", "part", "joint_pivot", "joint_axis", "joint_state")
    part = np.where(truth["part"] == 255, 0, truth["part"]).astype(np.uint8)
    predictions = tmp_path / "p.safetensors"
    header = {"format": store.PREDICTIONS, "method": "mine", "category": "laptop", "variant": "",
              "split": "train", "seed": 1, "data_digest": split.manifest.digest,
              "supervision": []}  # fmt: skip
    store.write(
        predictions,
        {"part": part, "joint_pivot": truth["joint_pivot"], "joint_axis": truth["joint_axis"]},
        header,
    )
    out = tmp_path / "pictures" / "laptop.png"
    predictions_picture(split, predictions, out, [0, 1, 2])
    assert [path.name for path in out.parent.iterdir()] == ["laptop.png"]
    for color in PART_COLORS[:2]:
        assert color_count(out, color) > 3


@pytest.mark.parametrize("stages", [1, 2])
def test_training_curve_has_a_panel_for_each_stage(tmp_path: Path, stages: int) -> None:
    rows = [
        {"stage": f"stage {s}", "step": step, "loss": 1.0 / (step + 1), "loss/rec": 0.5}
        for s in range(stages)
        for step in range(10)
    ]
    (tmp_path / "metrics.jsonl").write_text("\n".join(json.dumps(row) for row in rows))
    out = tmp_path / "curve.png"
    training_curve(tmp_path / "metrics.jsonl", out)
    with Image.open(out) as image:
        assert image.width == 650 * stages
    assert color_count(out, "#1f77b4") > 50  # a term
    assert color_count(out, "#000000") > 50  # their sum
