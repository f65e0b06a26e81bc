# SPDX-License-Identifier: MIT
"""A method's own conventions, made up here, are undone to the truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.infer.alignment import Alignment, Parts, aligned
from bench.infer.calibrate import Labelled, fit_alignment
from bench.twin.record import Twin
from scapo.categories import CATEGORIES, Category

UNIT = 0.7


def pose(rng: np.random.Generator) -> np.ndarray:
    made = np.eye(4)
    made[:3, :3] = Rotation.random(rng=rng).as_matrix()
    made[:3, 3] = rng.normal(size=3)
    return made


def true_parts(category: Category, rng: np.random.Generator) -> Parts:
    joints = len(category.joints)
    axis = rng.normal(size=(joints, 3))
    return Parts.of(
        category,
        camera_T_base=pose(rng),
        pivot=rng.normal(size=(joints, 3)),
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        state=rng.uniform(0.2, 1, joints),
        limits=np.array([[0, 1.2]] * joints),
    )


def in_own_words(truth: Parts, convention: Alignment, unit: float, category: Category) -> Parts:
    """The same object as a method with these conventions has it."""
    slides = np.array([spec.kind == "prismatic" for spec in category.joints])
    sign = np.array(convention.sign)
    zero = np.array(convention.zero) * np.where(slides, unit, 1.0)
    offset = np.array(convention.base)
    offset[:3, 3] *= unit
    state = sign * (truth.state - zero)
    limits = np.sort(sign[:, None] * (truth.limits - zero[:, None]), axis=1)
    plain = Parts.of(
        category,
        camera_T_base=truth.camera_T_part[0] @ np.linalg.inv(offset),
        pivot=truth.pivot, axis=sign[:, None] * truth.axis, state=state, limits=limits,
    )  # fmt: skip
    order = convention.order
    if order == (1, 0):  # the door is its base: what moves is the body, the other way
        return Parts.of(
            category, camera_T_base=plain.camera_T_part[1], pivot=plain.pivot, axis=plain.axis,
            state=-state, limits=np.sort(-limits, axis=1),
        )  # fmt: skip
    index = np.array(order[1:]) - 1
    return Parts.of(
        category, camera_T_base=plain.camera_T_part[0], pivot=plain.pivot[index],
        axis=plain.axis[index], state=state[index], limits=limits[index],
    )  # fmt: skip


CASES = [
    ("oven", (0, 1)), ("oven", (1, 0)), ("drawer", (0, 1)), ("eyeglasses", (0, 2, 1)),
    ("basket", (0, 1, 2)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "order"), CASES)
def test_conventions_are_undone(name, order):
    category, rng = CATEGORIES[name], np.random.default_rng(0)
    joints = len(category.joints)
    # The fit of a swapped base's frame and zero goes through the joint, so both take part here.
    convention = Alignment(
        order=order, base=tuple(map(tuple, pose(rng).tolist())),
        sign=tuple(rng.choice([-1.0, 1.0], joints)), zero=tuple(rng.uniform(-1, 1, joints)),
    )  # fmt: skip
    for _ in range(3):
        truth = true_parts(category, rng)
        found = aligned(in_own_words(truth, convention, UNIT, category), convention, UNIT, category)
        np.testing.assert_allclose(found.camera_T_part, truth.camera_T_part, atol=1e-9)
        np.testing.assert_allclose(found.axis, truth.axis, atol=1e-12)
        np.testing.assert_allclose(found.state, truth.state, atol=1e-12)
        assert found.limits is not None
        assert truth.limits is not None
        np.testing.assert_allclose(found.limits, truth.limits, atol=1e-12)


def twin_of(parts: Parts, label: np.ndarray, category: Category) -> Twin:
    assert parts.limits is not None
    return Twin(
        name="a", category=category, points=np.zeros((len(label), 3)), part=label,
        camera_T_part=parts.camera_T_part, pivot=parts.pivot, axis=parts.axis, state=parts.state,
        limits=parts.limits,
    )  # fmt: skip


@pytest.mark.parametrize(("name", "order"), CASES)
def test_they_are_found_from_labelled_clouds_a_few_of_which_are_answered_wrong(name, order):
    category, rng = CATEGORIES[name], np.random.default_rng(1)
    joints, parts = len(category.joints), len(category.parts)
    convention = Alignment(
        order=order, base=tuple(map(tuple, pose(rng).tolist())),
        sign=tuple(rng.choice([-1.0, 1.0], joints)), zero=tuple(rng.uniform(-1, 1, joints)),
    )  # fmt: skip
    truths = [true_parts(category, rng) for _ in range(30)]
    points = rng.normal(size=(30, 50, 3)) * rng.uniform(0.1, 0.5, (30, 1, 1))
    units = 4 * np.linalg.norm(points - points.mean(1, keepdims=True), axis=-1).mean(1)
    part = rng.integers(0, parts, (30, 50))
    slot = np.array([order.index(p) for p in range(parts)])
    twins = []
    for k in range(30):
        answered = true_parts(category, rng) if k % 6 == 0 else truths[k]
        own = in_own_words(answered, convention, units[k], category)
        twins.append(twin_of(own, slot[part[k]], category))
    labelled = Labelled(
        points=points, part=part, camera_T_part=np.stack([t.camera_T_part for t in truths]),
        axis=np.stack([t.axis for t in truths]), state=np.stack([t.state for t in truths]),
        instance=np.arange(30),
    )  # fmt: skip
    found = fit_alignment(twins, labelled, category)
    assert found.order == order
    assert found.sign == convention.sign
    np.testing.assert_allclose(found.zero, convention.zero, atol=0.06)
    np.testing.assert_allclose(found.base, convention.base, atol=0.02)
