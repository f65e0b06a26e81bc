# SPDX-License-Identifier: MIT
"""The nine categories are those of docs/data-format.md, and their numbers are possible."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scapo.categories import CATEGORIES, Category, category

# name: parts, kinds of the joints, benchmark sets, diagonal of the symmetry
TABLE = {
    "laptop": (("base", "screen"), "r", ("clean", "sensor"), (1, -1, -1)),
    "safe": (("body", "door"), "r", ("clean",), None),
    "oven": (("body", "door"), "r", ("clean",), None),
    "washer": (("body", "door"), "r", ("clean",), None),
    "eyeglasses": (("frame", "left temple", "right temple"), "rr", ("clean",), (1, -1, -1)),
    "basket": (("body", "left handle", "right handle"), "rr", ("sensor",), (-1, -1, 1)),
    "drawer": (("body", "drawer"), "p", ("sensor",), None),
    "suitcase": (("body", "lid"), "r", ("sensor",), (1, -1, -1)),
    "scissors": (("first blade", "second blade"), "r", ("sensor",), (1, -1, -1)),
}

every = pytest.mark.parametrize("known", CATEGORIES.values(), ids=CATEGORIES)


def test_the_table_of_the_contract() -> None:
    assert list(CATEGORIES) == list(TABLE)
    for name, (parts, kinds, benchmark, diagonal) in TABLE.items():
        found = CATEGORIES[name]
        assert found.name == name
        assert found.parts == parts
        assert "".join(joint.kind[0] for joint in found.joints) == kinds
        assert found.benchmark == benchmark
        if diagonal is None:
            assert found.symmetry is None
        else:
            np.testing.assert_array_equal(found.symmetry, np.diag(diagonal))


@every
def test_joints_link_the_base_to_each_part_and_open_from_zero(known: Category) -> None:
    assert [(joint.parent, joint.child) for joint in known.joints] == [
        (0, i + 1) for i in range(len(known.parts) - 1)
    ]
    for joint in known.joints:
        assert joint.lower == 0
        most = math.pi if joint.kind == "revolute" else known.diagonal
        assert 0 < joint.upper < most


@every
def test_the_symmetry_is_half_a_turn(known: Category) -> None:
    if known.symmetry is not None:
        turn = np.array(known.symmetry, float)
        assert np.linalg.det(turn) == pytest.approx(1)
        np.testing.assert_allclose(turn @ turn, np.eye(3))
        assert Rotation.from_matrix(turn).magnitude() == pytest.approx(math.pi)


@every
def test_readings_of_what_turns_over_have_cameras_elsewhere(known: Category) -> None:
    """From above one, from below the other; of what does not turn over both are in the window."""
    if known.symmetry is None:
        assert not known.turns_over
        return
    low, high = np.radians(known.window.elevation)
    ring = np.radians(np.linspace(*known.window.azimuth, 9))
    height = np.array([low, (low + high) / 2, high])[:, None]
    shape = np.broadcast_shapes(ring.shape, height.shape)
    cameras = np.stack([
        -np.cos(ring) * np.cos(height), -np.sin(ring) * np.cos(height),
        np.broadcast_to(np.sin(height), shape),
    ], -1)  # fmt: skip
    turned = cameras @ np.array(known.symmetry, float)
    inside = np.arcsin(turned[..., 2]) >= low - 1e-9
    assert inside.all() or not inside.any()
    assert known.turns_over == (not inside.any() and known.name != "scissors")
    if not known.turns_over:
        assert known.window.azimuth == (-180, 180)  # whoever stands at one side stands at the other


@every
def test_the_window_is_where_a_person_looks_from(known: Category) -> None:
    """About the front, not from below, never exactly overhead, and wide enough to vary."""
    low, high = known.window.azimuth
    assert -180 <= low < high <= 180
    assert low == -high
    assert high - low >= 90
    low, high = known.window.elevation
    assert 0 <= low < high < 90
    assert high - low >= 30


@every
def test_sizes_and_words(known: Category) -> None:
    assert 0.1 < known.diagonal < 2
    assert known.words
    assert all(word == word.lower().strip() != "" for word in known.words)
    assert len(set(known.words)) == len(known.words)


def test_each_benchmark_set_holds_the_five_of_the_contract() -> None:
    for name, expected in (
        ("clean", {"laptop", "safe", "eyeglasses", "oven", "washer"}),
        ("sensor", {"basket", "drawer", "laptop", "scissors", "suitcase"}),
    ):
        assert {key for key, known in CATEGORIES.items() if name in known.benchmark} == expected


def test_a_category_by_its_name() -> None:
    assert category("oven") is CATEGORIES["oven"]
    with pytest.raises(ValueError, match="category 'car': expected one of laptop, safe, oven,"):
        category("car")
