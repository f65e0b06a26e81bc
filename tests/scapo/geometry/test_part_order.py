# SPDX-License-Identifier: MIT
"""Orders of parts, against counts made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from scapo.geometry.part_order import (
    confusion,
    hard_labels,
    joint_order,
    order_scores,
    part_orders,
)


def test_labels_of_weights_and_what_they_share_with_the_truth():
    weight = np.array([[[0.9, 0.1], [0.2, 0.8], [0.5, 0.5], [np.nan, 1.0]]])
    label = hard_labels(weight)
    assert label.tolist() == [[0, 1, 0, -1]]
    counts = confusion(np.array([[1, 0, 1, 0]]), label, 2)
    assert counts.tolist() == [[[0, 1], [2, 0]]]
    assert order_scores(counts, part_orders(2)).tolist() == [[0, 3]]


def test_the_base_of_three_parts_stays():
    assert part_orders(3).tolist() == [[0, 1, 2], [0, 2, 1]]


@pytest.mark.parametrize(
    ("order", "joints"), [([0, 1], [0]), ([1, 0], [0]), ([0, 2, 1], [1, 0]), ([1, 0, 2], [0, -1])]
)
def test_a_joint_is_named_by_the_parts_that_it_links(order, joints):
    assert joint_order(np.array([order])).tolist() == [joints]
