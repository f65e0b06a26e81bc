# SPDX-License-Identifier: MIT
"""Table 4, ours alone: the metrics of Table 1 where the paper prints average precision only."""

from __future__ import annotations

from dataclasses import replace

from bench.tables.model import Block, Table, mark_best
from bench.tables.results import Place, Results, Sampled, Series, measured
from bench.tables.rows import budget_notes, general_notes, in_order, listed_series, our_row
from bench.tables.spec import TABLE_1, TABLE_1_CATEGORIES, TABLE_2_CATEGORIES, Measure


def table_4(results: Results) -> Table:
    """Mean errors on `sensor`, and on the `clean` categories that Table 1 has not, if any."""
    series = results.series("clean")
    further = sorted({run.run.category for run in results.all_runs()} - {*TABLE_1_CATEGORIES})
    places = [Place("sensor", name) for name in TABLE_2_CATEGORIES]
    places += [
        Place("clean", name)
        for name in further
        if any(results.runs(one, Place("clean", name)) for one in series)
    ]
    blocks = [_block(results, measure, places) for measure in TABLE_1]
    clean = tuple(place.category for place in places if place.kind == "clean")
    return Table(
        number=4,
        title="Mean errors on sensor data, and without noise on categories that Table 1 has not",
        first="Metric",
        groups=(),
        columns=tuple(f"{place.category.capitalize()} ({place.kind})" for place in places),
        blocks=tuple(mark_best(block) for block in blocks if block.rows),
        notes=(
            *general_notes(),
            "Joint state: degrees, for a sliding joint cm.",
            *budget_notes(results, "sensor", TABLE_2_CATEGORIES),
            *budget_notes(results, "clean", clean),
        ),
    )


def _block(results: Results, measure: Measure, places: list[Place]) -> Block:
    with_order = measure.metric == "iou"
    series = {
        *listed_series(results, "sensor", with_order=with_order),
        *listed_series(results, "clean", with_order=with_order),
    }
    rows = [
        our_row(results, one, [_value(results, one, place, measure, seed)
                               for seed, place in enumerate(places)], mean=False)
        for one in sorted(series)
    ]  # fmt: skip
    heading = (
        measure.heading.replace("deg", "deg or cm")
        if measure.metric == "joint_state"
        else (measure.heading)
    )
    return Block(
        heading=f"{measure.symbol} {'↑' if measure.higher else '↓'} ({heading})",
        rows=tuple(in_order(rows)),
        higher=(measure.higher,) * len(places),
    )


def _value(
    results: Results, series: Series, place: Place, measure: Measure, seed: int
) -> Sampled | None:
    runs = results.runs(series, place)
    found = measured(runs, measure, seed)
    if found is None and measure.metric == "joint_state":
        return measured(runs, replace(measure, unit="m", factor=100), seed)
    return found
