# SPDX-License-Identifier: MIT
"""Table 4: mean errors of the sensor sets and of clean categories that Table 1 lacks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.tables.means import table_4
from bench.tables.results import load
from bench.tables.spec import TABLE_2_CATEGORIES
from tests.helpers.scored import make_scores


def test_columns_are_the_sensor_sets_and_the_clean_categories_of_no_other_table(
    tmp_path: Path,
) -> None:
    make_scores(tmp_path, "scapo", "laptop", kind="sensor")
    make_scores(tmp_path, "scapo", "basket", kind="clean")
    make_scores(tmp_path, "scapo", "oven", kind="clean")
    table = table_4(load(tmp_path))
    sensor = [f"{name.capitalize()} (sensor)" for name in TABLE_2_CATEGORIES]
    assert list(table.columns) == [*sensor, "Basket (clean)"]


def test_cells_are_means_over_samples_of_the_mean_over_slots(tmp_path: Path) -> None:
    errors = make_scores(tmp_path, "icp", "drawer", kind="sensor", quality=2.0)
    table = table_4(load(tmp_path))
    column = list(table.columns).index("Drawer (sensor)")
    found = {
        block.heading.split(" ")[0]: next(
            row.cells[column].value for row in block.rows if row.method == "ICP"
        )
        for block in table.blocks
    }
    expected = {
        "S": 100 * np.nanmean(errors["iou", "1"]),
        "D": np.mean(errors["joint_direction", "deg"]),
        "R": np.mean(errors["part_rotation", "deg"]),
        "t": np.mean(errors["part_translation", "r4"]),
    }
    for name, value in expected.items():
        assert found[name] == pytest.approx(value), name
