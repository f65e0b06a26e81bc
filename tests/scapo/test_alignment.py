# SPDX-License-Identifier: MIT
"""A method's own conventions, made up here, are undone to the truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch.testing import assert_close

from scapo.alignment import Alignment, ObjectFrame, unit_length
from scapo.categories import CATEGORIES
from scapo.records import map_tensors
from scapo.types import Prediction
from tests.helpers.conventions import CASES, CLOUDS, convention, in_own_words, true_answers

UNIT = torch.tensor([0.7, 0.2, 1.3], dtype=torch.float64)


@pytest.mark.parametrize(("name", "order"), CASES)
def test_conventions_are_undone(name: str, order: tuple[int, ...]) -> None:
    category, rng = CATEGORIES[name], np.random.default_rng(0)
    own = convention(order, rng)
    truth = true_answers(category, 3, rng)
    found = own.apply(in_own_words(truth, own, UNIT, category), UNIT, category)
    for field in ("part_weight", "camera_T_part", "joint_limits", "canonical_points",
                  "canonical_normals", "canonical_part"):  # fmt: skip
        assert_close(getattr(found, field), getattr(truth, field), atol=1e-9, rtol=0, msg=field)
    assert found.joints is not None
    assert truth.joints is not None
    for field in ("pivot", "axis", "state"):
        assert_close(getattr(found.joints, field), getattr(truth.joints, field), atol=1e-9, rtol=0)


def test_up_is_told_in_the_own_frame_of_a_base_that_comes_first() -> None:
    category, rng = CATEGORIES["eyeglasses"], np.random.default_rng(4)
    own, truth = convention((0, 2, 1), rng), true_answers(category, 3, rng)
    said = in_own_words(truth, own, UNIT, category).camera_T_part
    assert said is not None
    assert truth.camera_T_part is not None
    told = own.up()
    assert told is not None
    up = said[:, 0, :3, :3] @ torch.tensor(told, dtype=torch.float64)
    assert_close(up, truth.camera_T_part[:, 0, :3, 2], atol=1e-9, rtol=0)


def test_up_is_told_by_a_moving_part_that_comes_first_where_its_hinge_stands() -> None:
    own = convention((1, 0), np.random.default_rng(4))
    up = torch.tensor(own.own_T_part[1])[:3, 2]
    across = F.normalize(torch.linalg.cross(up, up.roll(1)), dim=0)
    some = ((None, False), (up[None], True), (-up[None], True), (across[None], False),
            (up.expand(2, 3), False))  # fmt: skip
    for axes, told in some:
        found = own.up(axes)
        assert (found is not None) == told
        assert found is None or found == pytest.approx(up.tolist())


def test_a_shape_whose_parts_nobody_knows_is_left_out_and_what_is_not_said_stays_so() -> None:
    category, rng = CATEGORIES["oven"], np.random.default_rng(1)
    truth = true_answers(category, 3, rng)
    bare = Prediction(part_weight=truth.part_weight, canonical_points=truth.canonical_points)
    found = convention((1, 0), rng).apply(bare, UNIT, category)
    assert_close(found.part_weight, truth.part_weight.flip(-1))
    assert (found.camera_T_part, found.joints, found.canonical_points) == (None, None, None)


def test_one_cloud_or_a_grid_of_clouds_is_answered_alike() -> None:
    category, rng = CATEGORIES["drawer"], np.random.default_rng(2)
    truth, own = true_answers(category, 6, rng), convention((1, 0), rng)
    unit = torch.rand(6, dtype=torch.float64)
    many = own.apply(truth, unit, category)
    grid = map_tensors(truth, lambda one: one.reshape(2, 3, *one.shape[1:]))
    shaped = own.apply(grid, unit.reshape(2, 3), category)
    one = own.apply(map_tensors(truth, lambda tensor: tensor[4]), unit[4], category)
    for field in ("camera_T_part", "canonical_points", "joint_limits"):
        assert_close(getattr(shaped, field).flatten(0, 1), getattr(many, field))
        assert_close(getattr(one, field), getattr(many, field)[4])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"order": (0, 0)}, "order: expected every part once"),
        ({"own_T_part": ()}, "own_T_part: expected 2 finite 4x4 matrices"),
        ({"own_T_part": (((2.0, 0, 0, 0), (0, 2.0, 0, 0), (0, 0, 2.0, 0), (0, 0, 0, 1.0)),) * 2},
         "expected rigid motions"),
        ({"sign": (0.5,)}, "signs 1 or -1"),
        ({"zero": ()}, "expected 1 of each"),
        ({"origin": (0.0, float("nan"), 0.0)}, "origin: expected finite numbers"),
    ],
)  # fmt: skip
def test_what_is_no_alignment_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(Alignment.of_order((0, 1), CLOUDS), **change)


def test_the_unit_is_four_times_the_mean_radius() -> None:
    cloud = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 3, 0], [0, -3, 0]])
    assert_close(unit_length(cloud + 5), torch.tensor(8.0))
    assert ObjectFrame.of(None) is None
    found = ObjectFrame.of(Alignment.of_order((1, 0), CLOUDS))
    assert found == ObjectFrame(
        split="train", data_digest="d" * 64, samples=30, mode="quick", order=(1, 0)
    )
