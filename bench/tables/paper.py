# SPDX-License-Identifier: MIT
"""The numbers printed in the paper's three tables, and what does not add up in them.

`paper.csv` holds every cell as printed (table, metric, method, category, value, supervision
marks); the printed means are shown and checked but never computed with.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from importlib.resources import files

from bench.tables.spec import ABLATIONS, PRECISION_KEYS, TABLE_1, TABLE_2_CATEGORIES

MEAN = "mean"


@dataclass(frozen=True, slots=True, kw_only=True)
class Printed:
    """One printed cell."""

    text: str
    """As printed."""
    marks: tuple[bool, bool, bool]
    """Pose, segmentation, joint supervision."""

    @property
    def value(self) -> float:
        """The number."""
        return float(self.text)

    @property
    def step(self) -> float:
        """One unit of the last printed digit."""
        digits = self.text.partition(".")[2]
        return 10.0 ** -len(digits)


Cells = dict[tuple[str, str, str, str], Printed]
"""(table, metric, method, category) -> cell."""


def printed_cells() -> Cells:
    """All cells of `paper.csv`."""
    text = files("bench").joinpath("paper.csv").read_text(encoding="utf-8")
    cells: Cells = {}
    for row in csv.DictReader(text.splitlines()):
        marks = tuple(row[f"supervision_{name}"] == "1" for name in ("pose", "seg", "joint"))
        key = (row["table"], row["metric"], row["method"], row["category"])
        cells[key] = Printed(text=row["value"], marks=(marks[0], marks[1], marks[2]))
    return cells


@dataclass(frozen=True, slots=True, kw_only=True)
class Mismatch:
    """A printed mean that is not the mean of its row."""

    table: str
    metric: str
    method: str
    printed: str
    recomputed: float

    @property
    def line(self) -> str:
        """For people."""
        digits = len(self.printed.partition(".")[2])
        return (
            f"Table {self.table} {self.metric} {self.method}: mean printed {self.printed}, "
            f"of its cells {self.recomputed:.{digits}f}"
        )


def mean_mismatches(cells: Cells) -> list[Mismatch]:
    """Printed means further from the mean of their cells than rounding of both allows."""
    found = []
    for (table, metric, method, category), cell in cells.items():
        if category != MEAN or table == "3":
            continue
        mean = _mean(cells, table, metric, method)
        if abs(mean - cell.value) > cell.step * (1 + 1e-6):
            found.append(
                Mismatch(
                    table=table, metric=metric, method=method, printed=cell.text, recomputed=mean
                )
            )
    return found


def row_cells(cells: Cells, table: str, metric: str, method: str) -> list[Printed]:
    """The cells behind a printed mean."""
    return [
        cell
        for (t, m, who, category), cell in cells.items()
        if (t, m, who) == (table, metric, method) and category != MEAN
    ]


def not_monotone(cells: Cells) -> list[str]:
    """Precision that falls as its threshold widens."""
    lines = []
    methods = {key[2] for key in cells if key[0] == "2"}
    for method in sorted(methods):
        for category in (*TABLE_2_CATEGORIES, MEAN):
            for group in (PRECISION_KEYS[:2], PRECISION_KEYS[2:5], PRECISION_KEYS[5:]):
                row = [cells["2", key, method, category] for key in group]
                lines += [
                    f"Table 2 {method} {category}: {a} {x.text} but {b} {y.text}"
                    for a, b, x, y in zip(group, group[1:], row, row[1:], strict=False)
                    if y.value < x.value
                ]
    return lines


MISPRINTS = ("Table 3 joint_dir wo_shape_var: printed '10.63.' with a stray dot",)
"""What `paper.csv` cannot hold."""


def consequences(cells: Cells) -> list[str]:
    """Leads of SCAPO over OP-Align that change when the means are computed from their cells."""
    wrong = {(m.table, m.metric, m.method) for m in mean_mismatches(cells)}
    lines = []
    for table, rival in (("1", "OP-Align"), ("2", "OP-Align(SJ)")):
        metrics = [b.key for b in TABLE_1 if b.printed] if table == "1" else PRECISION_KEYS
        for metric in metrics:
            if not {(table, metric, "Ours"), (table, metric, rival)} & wrong:
                continue
            printed = [cells[table, metric, who, MEAN].value for who in ("Ours", rival)]
            means = [_mean(cells, table, metric, who) for who in ("Ours", rival)]
            lines.append(
                f"Table {table} {metric}: Ours minus {rival} {printed[0] - printed[1]:+.2f} "
                f"as printed, {means[0] - means[1]:+.2f} from the cells"
            )
    return lines


def _mean(cells: Cells, table: str, metric: str, method: str) -> float:
    row = row_cells(cells, table, metric, method)
    return sum(cell.value for cell in row) / len(row)


def ablation_agrees(cells: Cells) -> list[str]:
    """Table 3's full row against the means of Table 1."""
    lines = []
    for metric in ("seg_iou", "joint_dir", "joint_pivot"):
        full, mean = cells["3", metric, ABLATIONS[0], MEAN], cells["1", metric, "Ours", MEAN]
        if full.value != mean.value:
            lines.append(f"Table 3 {metric} full: printed {full.text}, Table 1 has {mean.text}")
    return lines


def check() -> list[str]:
    """Everything that does not add up in the printed tables, one line each (docs/protocol.md)."""
    cells = printed_cells()
    return [
        *(mismatch.line for mismatch in mean_mismatches(cells)),
        *not_monotone(cells),
        *MISPRINTS,
        *ablation_agrees(cells),
        *consequences(cells),
    ]
