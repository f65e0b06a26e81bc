# SPDX-License-Identifier: MIT
"""Proportions of real models beside those of procedural instances, as Markdown tables.

python scripts/experiments/measure_models.py PATH [--count 100] [--seed 2] [--out FILE.md]

PATH holds `<group>/<id>/...` and an `index.csv` with the columns `category`, `id` and `urdf`.
Groups that are no category of ours are counted with the one that opens as they do (`ALIKE`).
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from scapo.categories import CATEGORIES
from sim_assets.models.reader import read
from sim_assets.objects import ArticulatedObject
from sim_assets.procedural import RECIPES, generate
from sim_assets.procedural.parameters import Options, Span
from sim_assets.procedural.variation import Statistic, statistics

ALIKE = {"dishwasher": "oven", "microwave": "safe", "fridge": "safe", "storage": "drawer"}
"""Doors that drop; doors with an upright hinge; cabinets with drawers."""


def real(path: Path) -> dict[str, list[ArticulatedObject]]:
    """The models of each category that can be read; the others are told on the console."""
    found: dict[str, list[ArticulatedObject]] = defaultdict(list)
    with (path / "index.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        category = ALIKE.get(row["category"], row["category"])
        if category not in CATEGORIES:
            continue
        urdf = path / row["category"] / row["id"] / row["urdf"]
        try:
            found[category].append(read(urdf, category))
        except ValueError as error:
            print(f"left out: {error}")
    return found


def cells(entry: Statistic | None) -> list[str]:
    """Count, mean, coefficient and range of a proportion."""
    if entry is None:
        return ["–"] * 4
    spread = f"{entry.variation:.2f}" if entry.count > 1 else "–"
    return [str(entry.count), f"{entry.mean:.3g}", spread, f"{entry.low:.2g} to {entry.high:.2g}"]


def variation_table(
    models: dict[str, list[ArticulatedObject]], count: int, seed: int
) -> Iterator[str]:
    """One row for each proportion of each category; main ones in bold."""
    heads = [
        f"{kind} {name}" for kind in ("real", "ours") for name in ("n", "mean", "CoV", "range")
    ]
    yield "| category | proportion | " + " | ".join(heads) + " |"
    yield "|---|---|" + "---|" * len(heads)
    for category in RECIPES:
        ours = statistics(generate(category, "train", seed, i) for i in range(count))
        theirs = {s.name: s for s in statistics(models[category])} if models.get(category) else {}
        for entry in ours:
            name = f"**{entry.name}**" if entry.main else entry.name
            row = [category, name, *cells(theirs.get(entry.name)), *cells(entry)]
            yield "| " + " | ".join(row) + " |"


def range_table() -> Iterator[str]:
    """What each recipe draws: its main proportions, and how many others and details."""
    yield "| category | main proportions: training (outer) range | lengths | details | traits |"
    yield "|---|---|---|---|---|"
    for category, recipe in RECIPES.items():
        drawn = {f.name: f.metadata["draw"] for f in fields(recipe.shape) if "draw" in f.metadata}
        main = [(name, drawn[name]) for name in recipe.main]
        told = "; ".join(
            f"{n} {s.low:g} to {s.high:g} ({s.least:g} to {s.most:g})" for n, s in main
        )
        spans = sum(isinstance(entry, Span) for entry in drawn.values())
        details = sum(isinstance(entry, Options) for entry in drawn.values())
        traits = ", ".join(recipe.rearranged)
        yield f"| {category} | {told} | {spans} | {details} | {traits} |"


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    lines = [*variation_table(real(given.path), given.count, given.seed), "", *range_table()]
    text = "\n".join(lines) + "\n"
    if given.out:
        given.out.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()
