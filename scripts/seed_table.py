#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""How far trainings of other seeds differ: a table from the reports of several `scapo-bench run`.

    python scripts/seed_table.py keep REPORTS.tar.xz OUT [OUT ...]
    python scripts/seed_table.py table REPORTS.tar.xz TABLE

`keep` adds the reports in `OUT/scores` to an archive, or exchanges them: scores of every sample
take fifty times as much, and trainings of one grid may come from several machines. `table` writes
TABLE.csv, a number a line, and TABLE.md, which is made from it alone.
"""

from __future__ import annotations

import io
import json
import sys
import tarfile
from pathlib import Path
from typing import Any, cast

import pandas as pd

from scapo.store.files import write_bytes

METRICS = {
    "S": ("iou_1", 100.0, ".1f"),
    "D": ("joint_direction_deg", 1.0, ".1f"),
    "C": ("joint_pivot_r4", 1.0, ".3f"),
    "R": ("part_rotation_deg", 1.0, ".1f"),
    "t": ("part_translation_r4", 1.0, ".3f"),
}
"""Key in a report's summary, factor, and how a table prints it."""
COSTS = ("seconds_per_cloud", "training_seconds", "training_gigabytes", "threads")
MODES = ("fast", "quick", "refine")
KEYS = ["mode", "part", "category", "seed"]
TITLE = """**Template registration, trained by several seeds**, `val`: mean [95 % interval over
objects] of S (%), D (degrees), C, R (degrees) and t; clouds a second as the run asked them, in
batches; minutes of training and memory at its peak; by so many threads, beside whatever else
ran."""


def reports_of(archive: Path) -> dict[str, bytes]:
    """By name, as an archive holds them."""
    if not archive.exists():
        return {}
    with tarfile.open(archive, "r:xz") as packed:
        held = {one.name: packed.extractfile(one) for one in packed.getmembers()}
        return {name: stream.read() for name, stream in held.items() if stream}


def keep(archive: Path, outs: list[Path]) -> int:
    """Add reports of plain scores to the archive, and say how many it holds."""
    held = reports_of(archive)
    for out in outs:
        found = [p for p in (out / "scores").glob("*/*.json") if p.name.count(".") == 1]
        if not found:
            raise ValueError(f"{out}: expected scores/PART/*.json, found none")
        held |= {path.relative_to(out / "scores").as_posix(): path.read_bytes() for path in found}
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:xz", preset=9) as packed:
        for name, data in sorted(held.items()):
            member = tarfile.TarInfo(name)
            member.size = len(data)  # and no time: equal reports give an equal archive
            packed.addfile(member, io.BytesIO(data))
    write_bytes(archive, stream.getvalue())
    return len(held)


def numbers(name: str, report: dict[str, Any]) -> list[dict[str, Any]]:
    """A report as rows: metrics with their intervals, then costs."""
    mode = report["variant"].rsplit("-", 1)[-1]
    key = {
        "mode": mode if mode in MODES else MODES[0],
        "part": name.split("/")[0],
        "category": report["category"],
        "seed": report["seed"],
    }
    budget = report["budget"] | {"threads": report["run"]["machine"]["threads"]}
    rows = [{**key, "what": what, "value": round(factor * one["mean"], 6),
             "low": round(factor * one["low"], 6), "high": round(factor * one["high"], 6)}
            for what, (metric, factor, _) in METRICS.items()
            for one in [report["summary"][metric]]]  # fmt: skip
    rows += [{**key, "what": what, "value": budget[what]} for what in COSTS if what in budget]
    return [row | {"commit": report["run"]["commit"]} for row in rows]


def _line(rows: pd.DataFrame) -> str:
    first, at = rows.iloc[0], rows.set_index("what")
    cells = [f"{at.value[w]:{f}} [{at.low[w]:{f}}, {at.high[w]:{f}}]"
             for w, (_, _, f) in METRICS.items()]  # fmt: skip
    cost = {w: float(at.value[w]) if w in at.index else float("nan") for w in COSTS}
    minutes = cost["training_seconds"] / 60
    cells += [f"{1 / cost['seconds_per_cloud']:.1f}", f"{minutes:.0f}",
              f"{cost['training_gigabytes']:.2f}", f"{cost['threads']:.0f}"]  # fmt: skip
    cells.append(first.commit)
    return f"| {first.category} ({first.part}) | {first.seed} | {' | '.join(cells)} |"


def _spread(rows: pd.DataFrame) -> list[str]:
    """Largest less least of the seeds, where there are two or more."""
    lines = [f"| mode | category | seeds | {' | '.join(METRICS)} |", "|---" * 8 + "|"]
    for key, one in rows.groupby(KEYS[:3]):
        if one.seed.nunique() > 1:
            mode, part, category = cast("tuple[str, str, str]", key)
            apart = one.groupby("what").value.agg(lambda v: v.max() - v.min())
            cells = [f"{apart[w]:{f}}" for w, (_, _, f) in METRICS.items()]
            seeds = ", ".join(str(s) for s in sorted(one.seed.unique()))
            lines.append(f"| {mode} | {category} ({part}) | {seeds} | " + " | ".join(cells) + " |")
    return lines


def markdown(rows: pd.DataFrame) -> str:
    """The table of a CSV."""
    lines = [TITLE]
    for mode, of_mode in rows.groupby("mode"):
        lines += ["", f"## `{mode}`", "",
                  f"| category | seed | {' | '.join(METRICS)} | clouds/s | min | GB | threads | "
                  "commit |",
                  "|---" * 7 + "|---:" * 4 + "|---|"]  # fmt: skip
        lines += [_line(one) for _, one in of_mode.groupby(KEYS)]
    if rows.groupby(KEYS[:3]).seed.nunique().max() > 1:
        lines += ["", "## Apart", "", "Largest less least over the seeds.", "", *_spread(rows)]
    return "\n".join(lines) + "\n"


def table(archive: Path, out: Path) -> int:
    """Write OUT.csv and OUT.md, and say how many lines."""
    rows = [row for name, data in reports_of(archive).items()
            for row in numbers(name, json.loads(data))]  # fmt: skip
    if not rows:
        raise ValueError(f"{archive}: expected reports, found none; keep some first")
    frame = pd.DataFrame(rows).sort_values([*KEYS, "what"], kind="stable")
    frame.to_csv(out.with_suffix(".csv"), index=False, lineterminator="\n")
    text = markdown(pd.read_csv(out.with_suffix(".csv"), dtype={"commit": str}))
    out.with_suffix(".md").write_text(text)
    return len(frame)


def main(words: list[str]) -> None:
    """Keep or table, as the first word says."""
    match words:
        case ["keep", archive, *outs] if outs:
            print(f"{archive}: {keep(Path(archive), [Path(out) for out in outs])} reports")
        case ["table", archive, out]:
            print(f"{out}.csv: {table(Path(archive), Path(out))} numbers")
        case _:
            sys.exit(__doc__)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except (OSError, ValueError) as error:
        sys.exit(f"seed_table: {error}")
