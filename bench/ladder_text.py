# SPDX-License-Identifier: MIT
"""The oracle ladder as Markdown to paste: every rung, and what each metric is limited by."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from bench.ladder import Rung
from bench.statistics import Interval

COLUMNS: dict[tuple[str, str], tuple[str, float, int]] = {
    ("iou", "1"): ("S, %", 100.0, 1),
    ("joint_direction", "deg"): ("D, deg", 1.0, 1),
    ("joint_pivot", "r4"): ("C", 1.0, 3),
    ("joint_state", "deg"): ("state, deg", 1.0, 1),
    ("joint_state", "r4"): ("state", 1.0, 3),
    ("part_rotation", "deg"): ("R, deg", 1.0, 1),
    ("part_translation", "r4"): ("t", 1.0, 3),
}
"""Metric -> heading, factor, decimals; lengths in 4 x mean radius."""
MEANINGS: dict[Rung, str] = {
    "predicted": "as predicted",
    "recomposed": "child poses from base, joint and state",
    "pose": "**true base pose**",
    "parts": "**true parts**",
    "joint": "**true joint** on the base",
    "state": "**true state**",
    "all": "all of them",
}
PIECES: tuple[Rung, ...] = ("pose", "parts", "joint", "state")
GAIN = 0.2
"""Share of a metric's error that a piece must cure to be named."""

Values = Mapping[Rung, Mapping[tuple[str, str], Interval]]
Medians = Mapping[Rung, Mapping[tuple[str, str], float]]


def ladder_markdown(ladder: Values, medians: Medians, title: str, facts: Mapping[str, str]) -> str:
    """A table `mean / median` per rung, the interval of the first, and a line per metric."""
    keys = [key for key in COLUMNS if key in ladder["predicted"]]
    lines = [
        f"### {title}: one piece replaced by the truth",
        "",
        "Mean / median over samples and slots; lengths C, t in units of 4 x mean radius.",
        "",
        _row(["", *(COLUMNS[key][0] for key in keys)]),
        _row(["---", *("---:" for _ in keys)]),
    ]
    for rung, values in ladder.items():
        cells = [f"{_text(key, values[key].mean)} / {_text(key, medians[rung][key])}"
                 for key in keys]  # fmt: skip
        lines.append(_row([MEANINGS[rung], *cells]))
        if rung == "predicted":
            lines.append(_row(["95 % interval of the mean",
                               *(_interval(key, values[key]) for key in keys)]))  # fmt: skip
    lines += ["", "What limits each metric:", "", *limits(ladder), ""]
    lines += [f"{name}: {value}  " for name, value in facts.items() if value]
    return "\n".join(lines).rstrip() + "\n"


def limits(ladder: Values) -> list[str]:
    """For each metric the pieces whose truth cures at least a fifth of its error, best first."""
    out = []
    for key, (heading, _, _) in COLUMNS.items():
        if key not in ladder["predicted"] or not ladder["predicted"][key].count:
            continue
        start = _error(key, ladder["predicted"][key].mean)
        named: list[str] = []
        for rung in sorted(PIECES, key=lambda rung: _error(key, ladder[rung][key].mean)):
            after = ladder[rung][key].mean
            cured = 1 - _error(key, after) / start if start > 0 else 0.0
            if cured >= GAIN:
                named.append(f"{rung} ({_text(key, after)}, cures {100 * cured:.0f} %)")
        first = f"- {heading.partition(',')[0]} {_text(key, ladder['predicted'][key].mean)}: "
        out.append(first + (", ".join(named) or "no single piece cures a fifth of it"))
    return out


def _error(key: tuple[str, str], value: float) -> float:
    return 1 - value if key[0] == "iou" else value


def _text(key: tuple[str, str], value: float) -> str:
    _, factor, decimals = COLUMNS[key]
    return "–" if value != value else f"{factor * value:.{decimals}f}"


def _interval(key: tuple[str, str], value: Interval) -> str:
    return f"{_text(key, value.low)} to {_text(key, value.high)}" if value.count else "–"


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
