# SPDX-License-Identifier: MIT
"""Predictions of a turned object that looks the same: `evaluate --ambiguity on`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.analysis.explain import measure
from bench.requests import Request, Settings
from bench.scoring.ambiguity import turned_truth
from bench.scoring.truth import blocks, revolute
from scapo.store import StoreError
from scapo.store.predictions import write_predictions
from tests.helpers import made
from tests.helpers.scoring import root, score

COUNT = 12
TURN = 3
ON = Settings(ambiguity="on")
HALF = np.diag([-1.0, -1.0, 1.0, 1.0])


def data(folder, name, exchanged=False):
    """A split whose even samples look alike under half a turn about a place of their own base."""
    arrays = made.sample_arrays(name, COUNT, 48, background=4)
    pose, state = arrays["camera_T_part"].astype(np.float64), arrays["joint_state"]
    about = np.eye(4)
    about[:3, 3] = 0.1, -0.2, 0.05
    turned = pose[:, 0] @ about @ HALF @ np.linalg.inv(about)
    even = np.arange(COUNT) % 2 == 0
    parts = pose.shape[1]
    alike = np.zeros((COUNT, 24), np.uint8)
    alike[:, 0], alike[even, TURN] = 1, 1
    base, states = np.repeat(pose[:, :1], 24, 1), np.repeat(state[:, None], 24, 1)
    base[even, TURN] = turned[even]
    part = np.tile(np.arange(parts, dtype=np.uint8), (COUNT, 24, 1))
    if exchanged:
        states[even, TURN] = state[even, ::-1]
        part[even, TURN] = 0, 2, 1
    arrays |= {"alike": alike, "alike_base": base.astype(np.float32),
               "alike_state": states.astype(np.float32), "alike_part": part}  # fmt: skip
    return made.write_split(folder, name, "test", arrays), arrays, turned


def turned_answer(split, arrays, turned, *, exchanged=False):
    """What a method says that takes every object for the turned one, joint by joint by scipy."""
    pose = arrays["camera_T_part"].astype(np.float64)
    label = arrays["part"].copy()
    state = arrays["joint_state"].astype(np.float64)
    if exchanged:
        label[arrays["part"] == 1], label[arrays["part"] == 2] = 2, 1
        state = state[:, ::-1]
    out = {"part": label, "joint_state": state, "camera_T_part": np.zeros_like(pose)}
    out["joint_pivot"], out["joint_axis"] = np.zeros((2, *state.shape, 3))
    out["camera_T_part"][:, 0] = turned
    for i in range(COUNT):
        carry = turned[i] @ np.linalg.inv(pose[i, 0])
        for j, joint in enumerate(split.manifest.joints):
            axis = carry[:3, :3] @ arrays["joint_axis"][i, j]
            pivot = carry[:3, :3] @ arrays["joint_pivot"][i, j] + carry[:3, 3]
            motion = np.eye(4)
            if joint.kind == "revolute":
                motion[:3, :3] = Rotation.from_rotvec(axis * state[i, j]).as_matrix()
                motion[:3, 3] = pivot - motion[:3, :3] @ pivot
            else:
                motion[:3, 3] = axis * state[i, j]
            out["joint_axis"][i, j], out["joint_pivot"][i, j] = axis, pivot
            out["camera_T_part"][i, j + 1] = motion @ turned[i]  # a motion in the camera frame
    return {name: v if name == "part" else v.astype(np.float32) for name, v in out.items()}


@pytest.mark.parametrize(
    ("name", "exchanged"),
    [("laptop", False), ("drawer", False), ("eyeglasses", False), ("eyeglasses", True)],
)
def test_the_turned_truth_is_right_where_it_looks_alike(name, exchanged, tmp_path):
    split, arrays, turned = data(tmp_path / "data", name, exchanged)
    answer = turned_answer(split, arrays, turned, exchanged=exchanged)
    off, plain = score(split, answer, tmp_path)
    on, report = score(split, answer, tmp_path, settings=ON)
    even = np.arange(COUNT) % 2 == 0
    base = off["part_rotation", "deg"][:, 0]
    if not exchanged:  # else the order of the parts, and with it the truth's turn, may be another
        np.testing.assert_allclose(base, 180, atol=0.1)
    assert (base[even] > 90).all()
    for (metric, unit), values in on.items():
        perfect = {"iou": 1, "order": np.arange(values.shape[1])}.get(metric, 0)
        expected = np.broadcast_to(perfect, values[even].shape)
        np.testing.assert_allclose(values[even], expected, atol=0.02, err_msg=f"{metric} {unit}")
        np.testing.assert_array_equal(values[~even], off[metric, unit][~even])
    assert plain["variant"] == ""
    assert report["variant"] == "[ambiguity=on]"
    assert report["settings"]["ambiguity"] == "on"


def test_the_truth_is_right_either_way(tmp_path):
    split, _, _ = data(tmp_path / "data", "laptop")
    answer = made.truth_as_prediction(split)
    off, _ = score(split, answer, tmp_path)
    on, _ = score(split, answer, tmp_path, settings=ON)
    for name, values in off.items():
        np.testing.assert_array_equal(on[name], values)


def test_a_method_without_poses_is_judged_by_its_axes(tmp_path):
    split, arrays, turned = data(tmp_path / "data", "laptop")
    answer = turned_answer(split, arrays, turned)
    del answer["camera_T_part"]
    on, _ = score(split, answer, tmp_path, settings=ON)
    assert on["joint_direction", "deg"][::2].max() < 0.02
    assert np.isnan(on["part_rotation", "deg"]).all()


def test_no_answer_stays_no_answer(tmp_path):
    split, arrays, turned = data(tmp_path / "data", "laptop")
    answer = turned_answer(split, arrays, turned)
    for name in answer:
        if name != "part":
            answer[name][0] = np.nan
    on, report = score(split, answer, tmp_path, settings=ON)
    assert np.isnan(on["part_rotation", "deg"][0]).all()
    assert report["summary"]["part_rotation_deg"]["undefined"] == 2


def test_a_part_without_an_answer_leaves_the_turn_to_the_others(tmp_path):
    """Its pose alone is empty; the other parts, and not the axes, still say which turn is meant."""
    split, arrays, turned = data(tmp_path / "data", "eyeglasses")
    answer = turned_answer(split, arrays, turned)
    answer["camera_T_part"][:, 2] = np.nan
    answer["joint_axis"] = np.roll(answer["joint_axis"], 1, 2)  # no turn explains these
    on, _ = score(split, answer, tmp_path, settings=ON)
    assert np.isnan(on["part_rotation", "deg"][:, 2]).all()
    assert on["part_rotation", "deg"][::2, :2].max() < 0.02


def test_data_that_do_not_say_are_refused(tmp_path):
    split = made.make_data(tmp_path / "data", "laptop", count=4, train=4, points=48)
    with pytest.raises(StoreError, match="expected tensor 'alike' for --ambiguity on"):
        score(split, made.truth_as_prediction(split), tmp_path, settings=ON)


def test_half_of_the_tensors_are_refused(tmp_path):
    _, arrays, _ = data(tmp_path / "one", "laptop")
    del arrays["alike_state"]
    split = made.write_split(tmp_path / "data", "laptop", "test", arrays)
    with pytest.raises(StoreError, match="expected tensor 'alike_state', found none"):
        score(split, made.truth_as_prediction(split), tmp_path)


def test_turned_truth_keeps_the_cloud_on_its_parts(tmp_path):
    """Points of a true part, relabelled, with the scale, background and visibility of the truth."""
    split, arrays, _ = data(tmp_path / "data", "eyeglasses", exchanged=True)
    (truth,) = blocks(split)
    members = np.array([4, 0])
    turned = turned_truth(truth, members, TURN, revolute(split.manifest))
    names = {-1: -1, 0: 0, 1: 2, 2: 1}
    for row, sample in enumerate(members):
        expected = [names[int(label)] for label in truth.part[sample]]
        assert turned.part[row].tolist() == expected
        assert turned.visible[row].tolist() == truth.visible[sample][[0, 2, 1]].tolist()
        assert turned.joint_state[row].tolist() == truth.joint_state[sample][::-1].tolist()
    np.testing.assert_array_equal(turned.points, arrays["points"][members])
    with pytest.raises(ValueError, match="expected the turns that look alike, found none"):
        turned_truth(turned, members, TURN, revolute(split.manifest))


def test_explain_tells_ambiguous_samples_apart(tmp_path):
    split, arrays, turned = data(tmp_path / "data", "laptop")
    path = tmp_path / "p.safetensors"
    write_predictions(path, made.header_of(split), turned_answer(split, arrays, turned))
    found = measure(Request(predictions=path, data=root(split), out=tmp_path))
    strata = [s for s in found.strata if (s.factor, s.metric) == ("ambiguous", "iou")]
    assert [(s.lower, s.upper, s.samples) for s in strata] == [(0.0, 0.5, 6), (0.5, 1.0, 6)]
    plain = made.make_data(tmp_path / "plain", "laptop", count=4, train=4, points=48)
    write_predictions(path, made.header_of(plain), made.truth_as_prediction(plain))
    found = measure(Request(predictions=path, data=root(plain), out=tmp_path))
    assert "ambiguous" not in {s.factor for s in found.strata}
