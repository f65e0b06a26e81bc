# SPDX-License-Identifier: MIT
"""Table 4: mean errors of the sensor sets and of clean categories that Table 1 lacks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.requests import Request
from bench.scoring.evaluate import evaluate
from bench.tables.means import table_1, table_4, table_5, table_6
from bench.tables.paper import printed_cells
from bench.tables.results import load
from bench.tables.spec import TABLE_2_CATEGORIES
from scapo.store.predictions import write_predictions
from tests.helpers import made
from tests.helpers.scored import OBJECTS, SAMPLES, make_scores


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


def cells(table, method: str, column: str) -> dict[str, float | None]:
    """Symbol of the block -> what its row of ours has in that column."""
    number = list(table.columns).index(column)
    return {
        block.heading.split(" ")[0]: row.cells[number].value
        for block in table.blocks
        for row in block.rows
        if (row.method, row.source) == (method, "ours")
    }


def test_each_kind_of_data_has_a_table_of_its_own(tmp_path: Path) -> None:
    errors = {
        kind: make_scores(tmp_path, "scapo", "oven", kind=kind, quality=quality,
                          digest=f"{number:012d}")["part_rotation", "deg"].mean()
        for number, (kind, quality) in enumerate(
            {"clean": 1, "complete": 2, "isolated": 3, "real": 4}.items())
    }  # fmt: skip
    results = load(tmp_path)
    printed = printed_cells()
    found = {
        "clean": table_1(results, "clean", printed, []),
        "complete": table_1(results, "complete", printed, []),
        "isolated": table_1(results, "isolated", printed, []),
        "real": table_5(results),
    }
    assert [table.number for table in found.values()] == ["1", "1-complete", "1b", "5"]
    for kind, table in found.items():
        column = "Oven (real)" if kind == "real" else "Oven"
        assert cells(table, "SCAPO", column)["R"] == pytest.approx(errors[kind]), kind
        papers = {row.source for block in table.blocks for row in block.rows}
        assert papers == ({"ours", "paper"} if kind in ("clean", "complete") else {"ours"})
    assert list(found["real"].columns) == ["Oven (real)", "Mean"]


def test_a_further_reading_stands_where_it_differs(tmp_path: Path) -> None:
    for variant, quality in (("", 1.0), ("[label-order=dataset]", 1.0), ("[ambiguity=on]", 0.5)):
        make_scores(tmp_path, "scapo", "oven", variant=variant, quality=quality)
    table = table_1(load(tmp_path), "clean", printed_cells(), [])
    rows = {
        block.heading[0]: [row.method for row in block.rows if row.source == "ours"]
        for block in table.blocks
    }
    assert rows["S"] == ["SCAPO"]
    assert rows["R"] == ["SCAPO", "SCAPO, ambiguity-aware"]
    further = [row for block in table.blocks for row in block.rows if row.plain]
    assert further
    assert not any(cell.best for row in further for cell in row.cells)
    assert "Not scored" not in " ".join(table.notes)


def test_objects_unlike_those_of_training_are_told_apart(tmp_path: Path) -> None:
    traits = ["", "proportions", "hinge set back", "proportions"] * 2
    make_scores(tmp_path, "scapo", "oven")
    unseen = make_scores(tmp_path, "scapo", "oven", split="test-ood", digest="a" * 12, quality=2.0,
                         traits=traits)  # fmt: skip
    table = table_6(load(tmp_path))
    assert list(table.columns) == ["Oven (clean)"]
    turn = unseen["part_rotation", "deg"]
    own = np.array(traits)[np.arange(len(turn)) % OBJECTS]
    rows = [row.method for row in table.blocks[0].rows]
    assert rows == [f"SCAPO, {name}"
                    for name in ("test", "test-ood", "hinge set back", "proportions")]  # fmt: skip
    for name in ("hinge set back", "proportions"):
        expected = turn[own == name].mean()
        assert cells(table, f"SCAPO, {name}", "Oven (clean)")["R"] == pytest.approx(expected)
    whole = cells(table, "SCAPO, test-ood", "Oven (clean)")["R"]
    assert whole == pytest.approx(turn.mean())
    # the other tables know nothing of these objects
    seen = table_1(load(tmp_path), "clean", printed_cells(), [])
    assert cells(seen, "SCAPO", "Oven")["R"] != pytest.approx(turn.mean())
    assert "test-ood" not in " ".join(note for note in seen.notes if "samples;" in note)


def test_the_share_of_swapped_samples_and_the_time_of_a_cloud(tmp_path: Path) -> None:
    order = np.tile([0.0, 1.0], (SAMPLES, 1))
    order[:10] = 1, 0
    order[10] = np.nan
    make_scores(tmp_path, "scapo", "oven", order=order, camera=True,
                budget={"seconds_per_cloud": 0.25, "batch": 32, "device": "cpu"})  # fmt: skip
    table = table_1(load(tmp_path), "clean", printed_cells(), [])
    found = cells(table, "SCAPO", "Oven")
    assert found["O"] == pytest.approx(100 * 10 / (SAMPLES - 1))
    assert found["Seconds"] == 0.25
    row = next(row for row in table.blocks[0].rows if row.source == "ours")
    assert row.camera is True
    assert "device cpu, batch 32, seconds per cloud 0.25; budget: not stated" in str(table.notes)


@pytest.mark.parametrize("said", [None, 0, 0.0, -1, "fast", True, float("1e300"), [1]])
def test_a_time_that_nobody_said_is_a_dash_and_never_zero(tmp_path: Path, said: object) -> None:
    budget = {} if said is None else {"seconds_per_cloud": said}
    make_scores(tmp_path, "foreign", "oven", budget=budget)
    make_scores(tmp_path, "scapo", "oven", budget={"seconds_per_cloud": 0.5})
    table = table_1(load(tmp_path), "clean", printed_cells(), [])
    assert "Seconds" not in cells(table, "foreign", "Oven")
    assert cells(table, "SCAPO", "Oven")["Seconds"] == 0.5
    note = next(note for note in table.notes if note.startswith("foreign, oven"))
    assert "device –, batch –, seconds per cloud –" in note
    row = next(row for row in table.blocks[0].rows if row.method == "foreign")
    assert row.camera is None


def test_a_method_without_joints_has_no_row_there(tmp_path: Path) -> None:
    """A foreign file of labels alone."""
    split = made.make_data(tmp_path / "data", "oven", count=6, train=6, points=32)
    (tmp_path / "scores").mkdir()
    path = tmp_path / "p.safetensors"
    labels = {"part": made.truth_as_prediction(split)["part"]}
    write_predictions(path, made.header_of(split), labels)
    evaluate(Request(predictions=path, data=tmp_path / "data",
                     out=tmp_path / "scores" / "x.csv.gz"))  # fmt: skip
    table = table_1(load(tmp_path / "scores"), "clean", printed_cells(), [])
    found = cells(table, "made", "Oven")
    assert found == {"S": pytest.approx(100), "O": pytest.approx(0)}
    assert "made (D, C, R, t, q)" in " ".join(table.notes)
