# SPDX-License-Identifier: MIT
"""Stability of methods whose answer is known: one that moves with its cloud, one that is blind."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from rich.console import Console
from scipy.spatial.transform import Rotation

from bench import __main__ as program
from bench.analysis.stability import (
    BOOTSTRAPS,
    MOTIONS,
    SHIFT,
    Plan,
    changes,
    equivariance,
    geometric_median,
    moved,
    random_motions,
    resampled,
    same_signs,
    scatter,
    summary,
)
from bench.cli.console import quantity, stability_tables
from bench.runs import stability as runs
from bench.statistics import BOOTSTRAP_SEED
from scapo.store.checkpoint import WEIGHTS, checkpoint_header, write_checkpoint
from tests.helpers.splits import write_split
from tests.helpers.tiny import TINY, tiny

TURNS = np.array([True])


def clouds(count=4, points=400, seed=0):
    """Lopsided clouds half a metre in front of the camera."""
    generator = np.random.default_rng(seed)
    own = generator.normal(size=(count, points, 3)) * [0.1, 0.06, 0.03]
    own += 0.05 * np.square(generator.normal(size=(count, points, 3)))  # no mirror symmetry
    turn = Rotation.random(count, rng=generator).as_matrix()
    return (own @ np.swapaxes(turn, 1, 2) + [0.1, 0, 0.8]).astype(np.float32)


def frames(points):
    """Principal frames, signs by third moments, in double precision."""
    wide = points.astype(np.float64)
    centre = wide.mean(1)
    apart = wide - centre[:, None]
    axes = np.linalg.eigh(np.swapaxes(apart, 1, 2) @ apart)[1]
    axes = axes * np.sign(((apart @ axes) ** 3).sum(1))[:, None]
    axes[..., 2] *= np.linalg.det(axes)[:, None]
    return axes, centre, apart @ axes


def answers(axes, centre, label):
    """Base in the frame, one joint about its first axis, a tenth of a metre off its centre."""
    count = len(centre)
    base = np.tile(np.eye(4), (count, 2, 1, 1))
    base[:, :, :3, :3], base[:, :, :3, 3] = axes[:, None], centre[:, None]
    return {
        "part_weight": np.eye(2)[label],
        "camera_T_part": base,
        "joint_pivot": (centre + 0.1 * axes[..., 1])[:, None],
        "joint_axis": axes[:, None, :, 0],
        "joint_state": np.full((count, 1), 0.5),
    }


def principal(points, sensor=None):
    del sensor
    """Moves with the cloud, exactly."""
    axes, centre, own = frames(points)
    return answers(axes, centre, (own[..., 0] > 0.02).astype(int))


def blind(points, sensor=None):
    del sensor
    """Says the same of every cloud; the first half of its points is part 0."""
    count, number = points.shape[:2]
    label = np.tile(np.arange(number) >= number // 2, (count, 1)).astype(int)
    return answers(np.tile(np.eye(3), (count, 1, 1)), np.tile([0.1, 0, 0.8], (count, 1)), label)


def test_a_method_that_moves_with_its_cloud_does_not_change() -> None:
    found = equivariance(principal, clouds(), TURNS, Plan(motions=3))
    assert tuple(found) == MOTIONS
    for kind, errors in found.items():
        for (name, unit), values in errors.items():
            assert values.shape == (4, (1 if kind == "none" else 3) * (2 if "part_" in name and
                                       name != "part_rotation" else 1))  # fmt: skip
            # float32 clouds a metre off: 1e-7 m, that is about 1e-4 degrees of their frames
            assert values.max() < {"1": 0.006, "deg": 0.02}.get(unit, 1e-4), (kind, name)
    assert all(values.max() == 0 for values in found["none"].values())


def test_a_blind_method_changes_by_the_motion() -> None:
    plan = Plan(motions=1, seed=5)
    found = equivariance(blind, clouds(), TURNS, plan)
    generator = torch.Generator().manual_seed(plan.seed)
    motions = {kind: random_motions(4, kind, generator) for kind in MOTIONS}
    for kind in MOTIONS:
        motion = motions[kind]
        angle = np.degrees(Rotation.from_matrix(motion[:, :3, :3]).magnitude())
        np.testing.assert_allclose(found[kind]["base_rotation", "deg"][:, 0], angle, atol=1e-5)
        np.testing.assert_allclose(found[kind]["part_rotation", "deg"][:, 0], angle, atol=1e-5)
        line = np.degrees(np.arccos(np.abs(motion[:, 0, 0]).clip(max=1)))  # its axis is x
        np.testing.assert_allclose(found[kind]["axis", "deg"][:, 0], line, atol=1e-4)
        assert found[kind]["labels", "1"].max() == 0
        # an axis that seems to point the other way seems to turn the other way, by 2 x 0.5 rad
        state = np.degrees(np.where(motion[:, 0, 0] < 0, 1.0, 0.0))
        np.testing.assert_allclose(found[kind]["state", "deg"][:, 0], state, atol=1e-5)
    shift = motions["translation"][:, :3, 3]
    assert np.abs(shift).max() <= SHIFT
    np.testing.assert_allclose(  # the axis is x: what moves along it does not show
        found["translation"]["pivot", "m"][:, 0], np.linalg.norm(shift[:, 1:], axis=1), atol=1e-6
    )
    radius = np.array([np.linalg.norm(c - c.mean(0), axis=1).mean() for c in clouds()])
    length = np.linalg.norm(shift, axis=1) / (4 * radius)
    np.testing.assert_allclose(
        found["translation"]["part_translation", "r4"], length[:, None].repeat(2, 1), rtol=1e-5
    )


def test_moved_is_undone_by_the_inverse_and_changes_are_those_of_the_answers() -> None:
    points = clouds()
    rows = principal(points)
    motion = random_motions(4, "both", torch.Generator().manual_seed(1))
    again = moved(moved(rows, motion), np.linalg.inv(motion))
    for name, values in rows.items():
        np.testing.assert_allclose(again[name], values, atol=1e-9)
    turn = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    other = dict(rows, joint_axis=-rows["joint_axis"], joint_state=-rows["joint_state"] + 0.1)
    other["camera_T_part"] = rows["camera_T_part"].copy()
    other["camera_T_part"][:, 1, :3, :3] = other["camera_T_part"][:, 1, :3, :3] @ turn
    other["joint_pivot"] = rows["joint_pivot"] + 0.7 * rows["joint_axis"]
    other["part_weight"] = rows["part_weight"].copy()
    other["part_weight"][:, :100] = other["part_weight"][:, :100, ::-1]
    found = changes(rows, other, points, TURNS)
    assert found["base_rotation", "deg"].max() == 0
    assert found["labels", "1"] == pytest.approx(0.25)
    assert found["part_rotation", "deg"] == pytest.approx(np.degrees(0.3))
    assert found["axis", "deg"].max() == pytest.approx(0, abs=1e-9)
    assert found["pivot", "m"].max() == pytest.approx(0, abs=1e-9)  # along the axis: the same line
    assert found["state", "deg"] == pytest.approx(np.degrees(0.1))


def test_a_sliding_state_is_in_the_clouds_own_unit_and_missing_answers_are_left_out() -> None:
    points = clouds()
    rows = principal(points)
    other = dict(rows, joint_state=rows["joint_state"] + 0.02)
    radius = np.array([np.linalg.norm(c - c.mean(0), axis=1).mean() for c in points])
    found = changes(rows, other, points, np.array([False]))
    np.testing.assert_allclose(found["state", "r4"][:, 0], 0.02 / (4 * radius), rtol=1e-5)
    labels = {"part": rows["part_weight"].argmax(-1)}
    assert set(changes(labels, labels, points, TURNS)) == {("labels", "1")}
    assert scatter([labels, labels], points) == {}


def test_scatter_of_axes_and_pivots_with_known_deviations() -> None:
    """Axes normal about z with 2 degrees each way, places with 1 cm each way across the axis."""
    generator = np.random.default_rng(0)
    points = clouds(1)
    centre = points.astype(np.float64).mean(1)
    rows = []
    for _ in range(4000):
        tilt = np.append(generator.normal(scale=np.radians(2), size=2), 1.0)
        place = centre + np.append(generator.normal(scale=0.01, size=2), 0)
        sign, along = generator.choice([-1, 1]), generator.normal()
        place = place + tilt / np.linalg.norm(tilt) * along
        rows.append({"joint_pivot": place[:, None], "joint_axis": sign * tilt[None, None]})
    found = scatter(rows, points)
    assert found["axis", "deg", "std"].item() == pytest.approx(2 * np.sqrt(2), rel=0.03)
    assert found["axis", "deg", "mad"].item() == pytest.approx(2 * 1.1774, rel=0.03)
    assert found["pivot", "m", "std"].item() == pytest.approx(0.01 * np.sqrt(2), rel=0.03)
    assert found["pivot", "m", "mad"].item() == pytest.approx(0.01 * 1.1774, rel=0.03)
    radius = np.linalg.norm(points[0] - centre, axis=1).mean()
    assert found["pivot", "r4", "std"] == pytest.approx(found["pivot", "m", "std"] / (4 * radius))


def test_mad_forgives_a_wild_answer_and_std_does_not() -> None:
    points = clouds(2)
    rows = [principal(points) for _ in range(20)]
    rows[3] = blind(points)
    found = scatter(rows, points)
    for name, unit in (("base_rotation", "deg"), ("axis", "deg"), ("pivot", "m")):
        assert found[name, unit, "mad"].max() < 1e-4
        assert found[name, unit, "std"].min() > {"deg": 1.0, "m": 0.002}[unit]


def test_same_signs_and_geometric_median() -> None:
    axes = np.array([[[0.1, 0, 2]], [[0, 0, -1]], [[0, 0.1, 1]]])
    assert len(set(np.sign(same_signs(axes)[:, 0, 2]))) == 1
    line = np.array([[0.0], [1.0], [10.0]])[:, None]
    assert geometric_median(line).item() == pytest.approx(1, abs=1e-6)


def test_resampling_draws_points_of_the_cloud_once_each() -> None:
    points, seen = clouds(2, 50), []

    def watched(subset, sensor):
        assert not sensor.any()
        seen.append(subset)
        return principal(subset)

    found = resampled(watched, points, Plan(resamplings=6, points=25, batch=2))
    assert len(seen) == 6
    for subset in seen:
        for cloud, whole in zip(subset, points, strict=True):
            rows = {tuple(point) for point in cloud.tolist()}
            assert len(rows) == 25
            assert rows <= {tuple(point) for point in whole.tolist()}
    assert found["axis", "deg", "std"].min() > 0.1
    with pytest.raises(ValueError, match=r"expected 1 to 49 of the clouds' 50 points, found 50"):
        resampled(watched, points, Plan(points=50))


def test_rotations_are_uniform_and_translations_fill_the_cube() -> None:
    motion = random_motions(4000, "both", torch.Generator().manual_seed(0))
    np.testing.assert_allclose(motion[:, :3, :3].mean(0), 0, atol=0.05)
    np.testing.assert_allclose(np.abs(motion[:, :3, 3]).max(0), SHIFT, atol=0.01)


def test_summary_names_the_tail_and_its_interval() -> None:
    values = np.arange(100.0)[:, None]
    values[7] = np.nan
    found = summary(values, np.arange(100) // 5)
    assert (found["count"], found["undefined"], found["max"]) == (99, 1, 99.0)
    assert found["median"]["value"] == pytest.approx(50)
    assert found["p95"]["low"] <= found["p95"]["value"] <= found["p95"]["high"]
    assert found["median"]["high"] - found["median"]["low"] > 10
    assert summary(np.full((3, 1), np.nan), np.arange(3)) == {"count": 0, "undefined": 3}


def test_intervals_are_those_of_one_draw_after_the_other() -> None:
    """Objects of unlike size, several values a sample, some without an answer."""
    generator = np.random.default_rng(2)
    values = generator.normal(size=(33, 3))
    values[generator.random(values.shape) < 0.3] = np.nan
    instance = generator.integers(7, size=33)
    values[instance == 3] = np.nan
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    kinds = np.unique(instance)
    medians = []
    for _ in range(BOOTSTRAPS):
        chosen = kinds[generator.integers(len(kinds), size=len(kinds))]
        drawn = np.concatenate([values[instance == kind].ravel() for kind in chosen])
        medians.append(np.nanmedian(drawn))
    low, high = np.quantile(medians, [0.025, 0.975])
    found = summary(values, instance)["median"]
    assert found["value"] == pytest.approx(np.nanmedian(values))
    np.testing.assert_allclose([found["low"], found["high"]], [low, high], atol=1e-12)


def test_clouds_in_another_frame_are_asked_about_from_their_cameras(tmp_path, monkeypatch) -> None:
    sensor = np.array([[0.3, -0.2, 0.5]] * 6, np.float32)
    change = {"points": clouds(6, 96) + sensor[:, None], "part": np.zeros((6, 96), np.uint8)}
    write_split(tmp_path / "data" / "laptop" / "test", split="test", counts=(6,), points=96,
                change=change | {"sensor": sensor})  # fmt: skip
    header = checkpoint_header("scapo", TINY, "laptop", {"seed": 3, "steps": 0})
    write_checkpoint(tmp_path / "run" / WEIGHTS, tiny(), header)
    asked, measure = [], runs.measure
    monkeypatch.setattr(runs, "measure", lambda *x: asked.append(x[1]) or measure(*x))
    program.main(["stability", str(tmp_path / "run"), "--data", str(tmp_path / "data"), "--out",
                  str(tmp_path / "out.json"), "--mode", "fast", "--samples", "6",
                  "--resamplings", "0", "--motions", "1"])  # fmt: skip
    np.testing.assert_allclose(asked[0], clouds(6, 96), atol=1e-6)


def test_the_command_writes_a_report_and_a_table(tmp_path, capsys) -> None:
    write_split(tmp_path / "data" / "laptop" / "test", split="test", counts=(6,), points=96,
                change={"points": clouds(6, 96), "part": np.zeros((6, 96), np.uint8)})  # fmt: skip
    header = checkpoint_header("scapo", TINY, "laptop", {"seed": 3, "steps": 0})
    write_checkpoint(tmp_path / "run" / WEIGHTS, tiny(), header)
    out = tmp_path / "stability.json"
    program.main(["stability", str(tmp_path / "run"), "--data", str(tmp_path / "data"), "--out",
                  str(out), "--mode", "fast", "--samples", "4", "--resamplings", "3",
                  "--device", "cpu"])  # fmt: skip
    report = json.loads(out.read_text())
    assert report["format"] == "scapo-stability/1"
    assert report["plan"]["points"] == 48
    assert report["data"]["samples"] == [0, 1, 3, 5]
    assert report["training"]["seed"] == 3
    assert report["config"]["preset"] == "cpu"
    assert report["machine"]["device"] == "cpu"
    assert report["commit"]
    (fast,) = report["modes"].values()
    assert fast["equivariance"]["rotation"]["base_rotation_deg"]["count"] == 8
    assert len(fast["resampling"]["pivot_r4_mad"]["per_sample"]) == 4
    assert "Report: " in capsys.readouterr().out
    console = Console(width=120, record=True)
    for found in stability_tables(report):
        console.print(found)
    printed = console.export_text()
    for text in ("median / p95", "turned", "resampled", "pivot, r4", "MAD, p95"):
        assert text in printed
    assert quantity("base_rotation_deg") == "base rotation, deg"
    assert quantity("labels_1") == "labels"
