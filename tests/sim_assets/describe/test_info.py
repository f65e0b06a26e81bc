# SPDX-License-Identifier: MIT
"""Histograms and joint states in words."""

from __future__ import annotations

import numpy as np

from sim_assets.describe.info import describe_state, histogram


def test_a_histogram_in_one_line():
    values = np.concatenate([np.zeros(8), np.ones(4)])
    line = histogram("name", values, "m")
    assert line.startswith("name ")
    assert "0 █" in line
    assert "▄ 1 m, mean 0.3333" in line
    assert "5 deg, mean 5" in histogram("constant", np.full(3, 5.0), "deg")


def test_states_in_words():
    assert describe_state(np.pi / 2, "revolute") == "90°"
    assert describe_state(0.123, "prismatic") == "12 cm"
    assert describe_state(float("nan"), "revolute") == "–"
