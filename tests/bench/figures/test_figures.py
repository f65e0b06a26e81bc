# SPDX-License-Identifier: MIT
"""Figures of a run: frames, templates, ranks, and the command that draws them."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from bench import __main__ as program
from bench.analysis.answered import read_answered, slots
from bench.figures.drawing import (
    DISTANCE,
    PALETTE,
    draw_line,
    draw_points,
    look,
    project,
    window,
)
from bench.figures.overlay import canonical, overlay_picture
from bench.figures.pictures import SHARES, badness, ranked, ranking_picture
from bench.figures.template import (
    TemplateShape,
    aligned_shape,
    at_states,
    carried,
    state_steps,
    template_picture,
    template_shape,
)
from bench.requests import Request
from scapo.categories import CATEGORIES, category
from scapo.geometry.matrices import moved
from scapo.registered.config import RegisteredConfig
from scapo.registered.method import TemplateRegistration
from scapo.registered.template import Placement
from scapo.store.checkpoint import WEIGHTS, checkpoint_header, write_checkpoint
from scapo.store.predictions import write_predictions
from tests.helpers import made
from tests.helpers.conventions import convention
from tests.helpers.strategies import generator
from tests.helpers.tiny import TINY, tiny


def answered_of(folder, name="laptop", change=None, **header):
    split = made.make_data(folder / "data", name, count=9, points=200)
    arrays = made.truth_as_prediction(split)
    arrays |= change(arrays) if change else {}
    path = folder / "p.safetensors"
    write_predictions(path, made.header_of(split, **header), arrays)
    request = Request(predictions=path, data=folder / "data", out=folder)
    return read_answered(request), path


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (90, 10), (-120, 60), (30, 89.9)])
def test_look_sees_the_front_upright_from_where_it_stands(azimuth, elevation) -> None:
    pose = look(azimuth, elevation)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose) == pytest.approx(1)
    assert moved(np.zeros((1, 3)), pose)[0].tolist() == [0, 0, DISTANCE]
    a, e = np.radians([azimuth, elevation])
    eye = DISTANCE * np.array([-np.cos(a) * np.cos(e), -np.sin(a) * np.cos(e), np.sin(e)])
    np.testing.assert_allclose(moved(eye[None], pose), 0, atol=1e-12)
    up = moved(np.array([[0, 0, 1.0]]), pose)[0]
    assert up[0] == pytest.approx(0, abs=1e-12)
    assert up[1] < 0  # y is down


def test_points_are_drawn_far_first_and_paler() -> None:
    axes = Figure().subplots()
    points = np.array([[0.0, 0, 1], [0.1, 0, 2], [0.2, 0, 3]])
    draw_points(axes, points, np.zeros((3, 3)), size=1)
    drawn = axes.collections[0]
    np.testing.assert_allclose(np.asarray(drawn.get_offsets()), project(points)[::-1])
    grey = np.asarray(drawn.get_facecolor())[:, 0]
    np.testing.assert_allclose(grey, [0.45, 0.225, 0])


def test_a_line_is_as_long_as_it_was_asked_to_be() -> None:
    axes = Figure().subplots()
    draw_line(axes, np.array([0, 0, 2.0]), np.array([0, 1.0, 0]), reach=0.5)
    assert len(axes.lines) == 2  # the seam and the line
    assert np.ptp(np.asarray(axes.lines[-1].get_xydata()), axis=0).tolist() == [0, 0.5]
    window(axes, 2.5)
    assert axes.get_xlim() == (-0.5, 0.5)
    assert axes.get_ylim() == (0.5, -0.5)


def test_slots_are_the_inverse_of_the_order() -> None:
    order = np.array([[0, 2, 1], [0, 1, 2], [2, 0, 1]])
    part = np.array([[0, 1, 2, -1]] * 3)
    assert slots(part, order).tolist() == [[0, 2, 1, -1], [0, 1, 2, -1], [1, 2, 0, -1]]


def test_the_truth_overlaid_is_in_the_object_frame_and_on_itself(tmp_path) -> None:
    answered, _ = answered_of(tmp_path)
    samples = np.arange(9)
    mine = canonical(answered, answered.mine, answered.part, samples)
    true = canonical(answered, answered.true, answered.part_true, samples)
    for a, b in zip(mine, true, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    points, part, places, directions = mine
    truth = answered.split.arrays("camera_T_part", "points", "joint_axis", "joint_pivot")
    inverse = np.linalg.inv(truth["camera_T_part"][4, 0].astype(float))
    expected = moved(truth["points"][4], inverse) / answered.scale[4]
    np.testing.assert_allclose(points.reshape(9, -1, 3)[4], expected, atol=1e-5)
    np.testing.assert_allclose(
        directions[4], inverse[:3, :3] @ truth["joint_axis"][4, 0], atol=1e-5
    )
    away = places[4] - moved(truth["joint_pivot"][4], inverse)[0] / answered.scale[4]
    assert np.linalg.norm(np.cross(away, directions[4])) < 1e-5
    assert abs((places[4] - expected.mean(0)) @ directions[4]) < 1e-5
    assert part.shape == (9 * 200,)


def test_badness_counts_errors_by_their_share_and_ranks_them() -> None:
    errors = {key: np.full((4, 2), 0.0) for key in SHARES}
    errors["iou", "1"][:] = 1
    errors["joint_direction", "deg"][1] = 8.0  # twice its share, one metric of five
    errors["part_rotation", "deg"][2] = 180.0  # counted as ten
    for values in errors.values():
        values[3] = np.nan
    value = badness(errors)
    np.testing.assert_allclose(value, [0, 0.4, 2, np.inf])
    assert ranked(value).tolist() == [0, 1, 2]
    assert ranked(np.arange(100.0)[::-1], 3).tolist() == [99, 49, 0]


def hinge():
    """A square base at the origin and a lid on it, hinged about y at x = 0.5."""
    points = np.array([[-0.5, 0.2, 0], [0.5, -0.2, 0], [-0.5, 0.2, 0.1], [-0.5, -0.2, 0.1]])
    return TemplateShape(
        points=points, weight=np.eye(2)[[0, 0, 1, 1]], pivot=np.array([[0.5, 3.0, 0.1]]),
        axis=np.array([[0, 1.0, 0]]), normals=np.tile([0, 0, 1.0], (4, 1)),
    )  # fmt: skip


def test_a_template_opens_about_its_joint() -> None:
    opened = at_states(hinge(), np.array([np.pi / 2]), np.array([True]))
    np.testing.assert_allclose(opened.points[:2], hinge().points[:2], atol=1e-12)
    np.testing.assert_allclose(opened.points[2], [0.5, 0.2, 1.1], atol=1e-12)
    assert opened.normals is not None
    np.testing.assert_allclose(opened.normals[2], [1, 0, 0], atol=1e-12)
    slid = at_states(hinge(), np.array([0.3]), np.array([False]))
    np.testing.assert_allclose(
        slid.points[2:], hinge().points[2:] + np.array([0, 0.3, 0]), atol=1e-12
    )
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [1, 2, 3]
    there = at_states(carried(hinge(), pose), np.array([0.4]), np.array([True]))
    here = carried(at_states(hinge(), np.array([0.4]), np.array([True])), pose)
    np.testing.assert_allclose(there.points, here.points, atol=1e-12)


def test_states_run_from_closed_to_open_whatever_the_sign_of_the_joint(tmp_path) -> None:
    def reverse(arrays):
        return {"joint_axis": -arrays["joint_axis"], "joint_state": -arrays["joint_state"]}

    straight, path = answered_of(tmp_path / "a")
    own, shown = state_steps(straight, path)
    np.testing.assert_allclose(own, shown)
    assert own[0] < own[1] < own[2]
    turned, path = answered_of(tmp_path / "b", change=reverse)
    own_reversed, shown_reversed = state_steps(turned, path)
    np.testing.assert_allclose(own_reversed, -np.array(own))
    np.testing.assert_allclose(shown_reversed, shown)


def test_a_sliding_state_is_drawn_in_clouds_sizes_and_told_in_metres(tmp_path) -> None:
    answered, path = answered_of(tmp_path, "drawer")
    own, shown = state_steps(answered, path)
    truth = answered.split.arrays("joint_state")["joint_state"][:, 0]
    np.testing.assert_allclose(own[1], np.median(truth / answered.scale), rtol=1e-5)
    np.testing.assert_allclose(shown[1], own[1] * np.median(answered.scale), rtol=1e-5)


def test_templates_of_both_methods() -> None:
    shape = template_shape(tiny())
    assert shape is not None
    assert shape.points.shape == (64, 3)
    np.testing.assert_allclose(shape.weight.sum(1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(shape.axis, axis=1), 1, atol=1e-5)
    method = TemplateRegistration(RegisteredConfig(), category("laptop"), generator(0))
    points = torch.randn(30, 3, generator=generator(1))
    normals = torch.nn.functional.normalize(points, dim=-1)
    method.template.assign(points, normals, torch.stack([points[:, 2], -points[:, 2]], 1) * 9)
    shape = template_shape(method)
    assert shape is not None
    poses = method.template.points.detach().numpy()
    moved = shape.points - poses  # the origin of the part frames
    np.testing.assert_allclose(moved, moved[:1].repeat(len(moved), 0), atol=1e-6)
    base = shape.points[shape.weight.argmax(1) == 0]
    np.testing.assert_allclose(np.quantile(base, [0.02, 0.98], axis=0).mean(0), 0, atol=1e-5)


def test_a_template_in_the_objects_frame_moves_as_the_category_says() -> None:
    own = convention((1, 0), np.random.default_rng(4))
    shape, category = hinge(), CATEGORIES["oven"]
    found = aligned_shape(shape, own, category)
    part = shape.weight.argmax(1)
    np.testing.assert_array_equal(found.weight, shape.weight[:, ::-1])
    for slot in (0, 1):  # a part's points at rest are those of its own frame, undone
        inverse = np.linalg.inv(np.array(own.own_T_part[own.order[slot]]))
        expected = moved(shape.points[part == slot], inverse)
        np.testing.assert_allclose(found.points[part == slot], expected, atol=1e-12)
    base = np.linalg.inv(np.array(own.own_T_part[0]))
    np.testing.assert_allclose(found.pivot, moved(shape.pivot, base), atol=1e-12)
    np.testing.assert_allclose(found.axis, own.sign[0] * shape.axis @ base[:3, :3].T, atol=1e-12)


@torch.no_grad()
def test_a_template_whose_hinges_lean_is_drawn_from_their_rest() -> None:
    method = TemplateRegistration(RegisteredConfig(), category("laptop"), generator(0))
    template, g = method.template, generator(1)
    for tensor in (template.points, template.logit, template.axis, template.pivot):
        tensor.copy_(torch.randn(tensor.shape, generator=g))
    template.normals.copy_(torch.randn(template.normals.shape, generator=g))
    template.rest.fill_(0.6)
    template.logit.mul_(40)
    shape = template_shape(method)
    assert shape is not None
    drawn = at_states(shape, np.array([0.3]), np.array([True])).points
    placed = Placement.at(torch.eye(3)[None], torch.zeros(1, 3), torch.tensor([[0.9]]))
    points = template.place(placed)[0][0] - template.part_centres()[0]
    hard = template.logit.softmax(-1).amax(-1) > 0.999999
    np.testing.assert_allclose(drawn[hard], points[hard].numpy(), atol=1e-4)


def test_figures_show_parts(tmp_path) -> None:
    answered, path = answered_of(tmp_path)
    overlay_picture(answered, tmp_path / "overlay.png", np.arange(9))
    ranking_picture(answered, path, tmp_path / "ranking.png")
    template_picture(answered, hinge(), path, tmp_path / "template.png")
    for name in ("overlay", "ranking", "template"):
        with Image.open(tmp_path / f"{name}.png") as image:
            pixels = np.asarray(image.convert("RGB")).astype(float) / 255
        for color in PALETTE[:2]:  # some of them pale or in shadow
            towards = color - color.mean()
            hue = (pixels - pixels.mean(-1, keepdims=True)) @ towards / np.square(towards).sum()
            assert (hue > 0.4).sum() > 20, name


def test_the_command_draws_what_there_is(tmp_path, capsys) -> None:
    split = made.make_data(tmp_path / "data", "laptop", count=6, points=64)
    run = tmp_path / "run"
    header = checkpoint_header("scapo", TINY, "laptop", {"seed": 1, "steps": 0})
    write_checkpoint(run / WEIGHTS, tiny(), header)
    rows = [{"stage": "a", "step": step, "loss": 1 / (1 + step)} for step in range(5)]
    (run / "metrics.jsonl").write_text("\n".join(json.dumps(row) for row in rows))
    data = tmp_path / "data"
    for name in ("train", "test"):
        program.main(["predict", str(run), "--data", str(data), "--split", name, "--device", "cpu",
                      "--out", str(tmp_path / f"{name}.safetensors")])  # fmt: skip
    words = ["pictures", str(run), "--data", str(data), "--out", str(tmp_path / "out")]
    program.main([*words, "--predictions", str(tmp_path / "test.safetensors"), "--calibration",
                  str(tmp_path / "train.safetensors")])  # fmt: skip
    names = {"overlay.png", "template.png", "ranking.png", "training.png"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    labels = {"part": made.truth_as_prediction(split)["part"]}
    write_predictions(tmp_path / "l.safetensors", made.header_of(split, method="scapo"), labels)
    (run / "metrics.jsonl").unlink()
    capsys.readouterr()
    program.main([*words[:-1], str(tmp_path / "less"), "--predictions",
                  str(tmp_path / "l.safetensors")])  # fmt: skip
    assert [path.name for path in (tmp_path / "less").iterdir()] == ["ranking.png"]
    assert capsys.readouterr().out.count("left out") == 3
    made.write_truth(tmp_path / "other.safetensors", split)
    with pytest.raises(SystemExit):
        program.main([*words, "--predictions", str(tmp_path / "other.safetensors")])
    assert "expected 'scapo' as in the run, found 'made'" in capsys.readouterr().err
