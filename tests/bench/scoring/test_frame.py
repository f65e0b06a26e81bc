# SPDX-License-Identifier: MIT
"""A method's conventions are found from labelled clouds, a few of which are answered wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from bench.scoring.frame import LEAST_SAMPLES, fit_alignment, middle
from bench.scoring.truth import Truth, truth_of
from scapo.categories import CATEGORIES
from scapo.records import cat, take
from scapo.types import Prediction
from tests.helpers.conventions import CASES, CLOUDS, convention, in_own_words, true_answers

COUNT = 36


def truth_like(truth: Prediction, rng: np.random.Generator) -> Truth:
    """Labelled clouds of random points whose true answers are these."""
    assert truth.joints is not None
    assert truth.camera_T_part is not None
    points = rng.normal(size=(COUNT, 50, 3)) * rng.uniform(0.1, 0.5, (COUNT, 1, 1))
    rows = {
        "points": points.astype(np.float32), "part": truth.part_weight.argmax(-1).numpy(),
        "camera_T_part": truth.camera_T_part.numpy(), "joint_pivot": truth.joints.pivot.numpy(),
        "joint_axis": truth.joints.axis.numpy(), "joint_state": truth.joints.state.numpy(),
        "visible": np.ones(truth.camera_T_part.shape[:2]), "instance": np.arange(COUNT),
    }  # fmt: skip
    return truth_of(Path("memory"), 0, rows)


@pytest.mark.parametrize(("name", "order"), CASES)
def test_conventions_are_found(name: str, order: tuple[int, ...]) -> None:
    category, rng = CATEGORIES[name], np.random.default_rng(1)
    own, true = convention(order, rng), true_answers(category, COUNT, rng)
    truth = truth_like(true, rng)
    wrong = true_answers(category, COUNT // 6, rng)
    wrong = replace(wrong, part_weight=true.part_weight[: COUNT // 6])
    answered = cat([wrong, take(true, torch.arange(COUNT // 6, COUNT))])
    unit = torch.as_tensor(truth.scale)
    found = fit_alignment(in_own_words(answered, own, unit, category), truth, CLOUDS, category)
    assert found is not None
    assert found.order == order
    assert found.sign == own.sign
    np.testing.assert_allclose(found.zero, own.zero, atol=0.06)
    np.testing.assert_allclose(found.own_T_part, own.own_T_part, atol=0.02)
    back = found.apply(in_own_words(true, own, unit, category), unit, category)
    assert_close(back.camera_T_part, true.camera_T_part, atol=0.05, rtol=0)


def test_too_few_answers_and_no_poses_give_none() -> None:
    category, rng = CATEGORIES["oven"], np.random.default_rng(2)
    true = true_answers(category, COUNT, rng)
    truth = truth_like(true, rng)
    assert fit_alignment(replace(true, camera_T_part=None), truth, CLOUDS, category) is None
    assert true.camera_T_part is not None
    pose = true.camera_T_part.clone()
    pose[LEAST_SAMPLES - 1 :, 1] = torch.nan
    assert fit_alignment(replace(true, camera_T_part=pose), truth, CLOUDS, category) is None
    pose[LEAST_SAMPLES - 1, 1] = true.camera_T_part[LEAST_SAMPLES - 1, 1]
    found = fit_alignment(replace(true, camera_T_part=pose, joints=None), truth, CLOUDS, category)
    assert found is not None
    assert (found.sign, found.zero) == ((1.0,), (0.0,))


def test_angles_are_taken_about_their_circular_mean() -> None:
    angles = np.array([[3.1], [-3.12], [3.13], [1.0], [np.nan]])
    assert middle(angles, np.array([True]))[0] % (2 * np.pi) == pytest.approx(3.115)
    lengths = np.array([[0.1, np.nan], [0.2, np.nan], [9.0, np.nan]])
    np.testing.assert_allclose(middle(lengths, np.array([False, True])), [0.2, 0])


def test_the_origin_is_that_of_the_whole_shape_where_parts_do_not_tell_it() -> None:
    """Frames from the end of objects that differ in length: no constant offset has the middle."""
    category, rng = CATEGORIES["oven"], np.random.default_rng(5)
    own, true = convention((0, 1), rng), true_answers(category, COUNT, rng)
    truth = truth_like(true, rng)
    unit = torch.as_tensor(truth.scale)
    assert true.canonical_points is not None
    assert true.camera_T_part is not None
    box = torch.tensor([0.1, 0.05, 0.02], dtype=torch.float64)  # of the middle, in units
    length = torch.as_tensor(rng.random((COUNT, 1, 1))) * unit[:, None, None]
    line = torch.linspace(-0.5, 0.5, true.canonical_points.shape[1])[:, None].double()
    shape = line * length * torch.tensor([1.0, 0, 0]) + (box * unit[:, None])[:, None]
    far = shape[:, -1] - (box * unit[:, None])
    pose = true.camera_T_part.clone()
    pose[..., :3, 3] += (pose[..., :3, :3] @ far[:, None, :, None])[..., 0]
    said = replace(true, camera_T_part=pose, canonical_points=shape - far[:, None])
    answered = in_own_words(said, own, unit, category)
    found = fit_alignment(answered, truth, CLOUDS, category)
    assert found is not None
    assert found.origin is not None
    back = found.apply(answered, unit, category)
    assert_close(back.camera_T_part, true.camera_T_part, atol=1e-3, rtol=0)
    assert_close(back.canonical_points, shape, atol=1e-3, rtol=0)
    without = replace(found, origin=None).apply(answered, unit, category)
    assert without.camera_T_part is not None
    assert (without.camera_T_part - true.camera_T_part).abs().mean() > 0.02


def test_no_origin_of_its_own_where_offsets_have_it() -> None:
    category, rng = CATEGORIES["oven"], np.random.default_rng(6)
    own, true = convention((0, 1), rng), true_answers(category, COUNT, rng)
    truth = truth_like(true, rng)
    unit = torch.as_tensor(truth.scale)
    found = fit_alignment(in_own_words(true, own, unit, category), truth, CLOUDS, category)
    assert found is not None
    assert found.origin is None
