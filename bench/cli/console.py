# SPDX-License-Identifier: MIT
"""What the verbs print: lines, tables, progress bars. Names are shown as they are, never obeyed."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
    track,
)
from rich.table import Table
from rich.text import Text

from scapo.text import one_line

if TYPE_CHECKING:
    from bench.grid.execute import Ended
    from bench.grid.run import Status
    from bench.tables.model import Table as ResultsTable
    from scapo.training.fit import Progress as Position

Item = TypeVar("Item")


def say(console: Console, line: object) -> None:
    """One line, however long, without markup and emoji."""
    console.print(Text(one_line(line)), soft_wrap=True)


def watched(console: Console, what: str) -> Callable[[Sequence[Item]], Iterable[Item]]:
    """Passes items on, with a bar."""
    return lambda items: track(items, description=what, console=console)


BAR = 16  # Characters: with the words of a step a bar fits a line of 80
LINE_EVERY = 30.0
"""Seconds between two lines of progress, at least, where the console is no terminal."""


@contextmanager
def stage_bars(console: Console) -> Iterator[Callable[[Position], None]]:
    """A listener of a training: one bar per stage and per start that tells of itself.

    Where the console is no terminal, a line now and then, and the bars as they are at the end.
    """
    bars = _StageBars(console)
    try:
        yield bars.show
    finally:
        if bars.tasks:
            bars.progress.stop()


class _StageBars:
    """The bars of one training, and when the last line was said."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=BAR),
            TextColumn("{task.percentage:>5.1f} %{task.fields[loss]}"),
            TimeElapsedColumn(),
            _TimeLeft(),
            console=console,
        )
        self.tasks: dict[tuple[str, bool], TaskID] = {}
        self.said, self.began = -LINE_EVERY, (0.0, 0.0)
        """When a line was said, and when this bar began, at which share."""

    def show(self, step: Position) -> None:
        """What a training says of itself."""
        name, starting, now = one_line(step.stage.name, 60), bool(step.step), time.monotonic()
        key, words = (name, starting), f"{name}: {one_line(step.step, 60)}" if starting else name
        if key not in self.tasks:
            self.progress.start()
            for (before, start), task in self.tasks.items():  # what was before is over
                done = escape(f"{before}: start" if start else before)
                self.progress.update(task, completed=1.0, description=done)
            self.tasks[key] = self.progress.add_task(escape(words), total=1.0, loss="", due=None)
            self.began = now, step.done
        loss = "" if step.loss is None else f"  loss {step.loss:.4f}"
        due = None if step.left is None else now + step.left
        self.progress.update(
            self.tasks[key], completed=step.done, description=escape(words), loss=loss, due=due
        )
        if not self.console.is_terminal and now - self.said >= LINE_EVERY:
            self.said, left = now, self._left(now, step)
            share = f"{100 * step.done:.0f} %{' of the start' if starting else loss}"
            shown = "" if left is None else f", about {clock(left)} left"
            say(self.console, f"{words}, {share}{shown}")

    def _left(self, now: float, step: Position) -> float | None:
        """Seconds that the stage or its start will still take, by what it says or by its pace."""
        began, first = self.began
        if step.left is not None or step.done <= first:
            return step.left
        return (now - began) * (1 - step.done) / (step.done - first)


class _TimeLeft(TimeRemainingColumn):
    """The time left: to the moment at which the task is due, or by its pace."""

    def render(self, task: Task) -> Text:
        """Hours, minutes and seconds."""
        due = task.fields["due"]
        if due is None or task.finished:
            return super().render(task)
        seconds = max(0, round(due - time.monotonic()))
        return Text(str(timedelta(seconds=seconds)), style="progress.remaining")


def summary_table(report: dict[str, Any]) -> Table:
    """Means, intervals and undefined values of an evaluation."""
    names = f"{report['method']} {report['category']} {report['split']}"
    table = _table(f"{names}, {report['counts']['samples']} samples")
    for heading in ("metric", "mean", "95 % interval", "undefined"):
        table.add_column(heading, justify="left" if heading == "metric" else "right")
    for name, row in report["summary"].items():
        metric, unit = name.rsplit("_", 1)
        known = row["mean"] is not None
        table.add_row(
            f"{metric}, {unit}" if unit != "1" else metric,
            f"{row['mean']:.4g}" if known else "–",
            f"{row['low']:.4g} to {row['high']:.4g}" if known else "–",
            str(row["undefined"]),
        )
    return table


SHOWN = 12
"""Trainings of a grid that are shown at a time."""


@contextmanager
def shown(console: Console, status: Status) -> Iterator[None]:
    """A table of what a grid does now, renewed each second where the console is a terminal."""
    if not console.is_terminal:
        yield
        return
    with Live(get_renderable=lambda: grid_table(status), console=console, refresh_per_second=1):
        yield


def grid_table(status: Status) -> Table:
    """What goes on now, how much is over and when all will be."""
    from bench.grid.execute import State

    counts, left = status.counts, status.seconds_left()
    words = [f"{counts[one]} {one}" for one in get_args(State) if counts[one]]
    known = {chain.name: chain for chain in status.chains}
    title = f"{len(status.running)} of {len(status.chains)} trainings at work"
    caption = f"steps: {', '.join(words) or 'none over'}; {in_words(*left)} left"
    table = Table("training", "step", "for", "of about", title=title, caption=caption)
    for name, (step, began) in list(status.running.items())[:SHOWN]:
        asked = next((one for one in known[name].steps if one.name == step), None)
        about = None if asked is None else status.estimate.of(known[name], asked)
        table.add_row(Text(name), Text(step), clock(time.monotonic() - began),
                      "–" if about is None else clock(about))  # fmt: skip
    return table


def chain_line(name: str, ended: Sequence[Ended]) -> Text:
    """How a training and what is made of it ended."""
    counts = Counter(one.state for one in ended)
    words = ", ".join(f"{count} {state}" for state, count in counts.items())
    took = clock(sum(one.seconds for one in ended if one.state == "made"))
    return Text(one_line(f"{name}: {words}, {took}"), style="red" if counts["failed"] else "")


def in_words(seconds: float, unknown: int) -> str:
    """An estimate, and what it leaves out."""
    return f"about {clock(seconds)}{f' and {unknown} steps nobody has timed' if unknown else ''}"


def clock(seconds: float) -> str:
    """Hours and minutes, or minutes and seconds.

    >>> clock(3725), clock(65)
    ('1 h 02 min', '1 min 05 s')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s"


def results_table(made: ResultsTable) -> Table:
    """A table of results as rows of text, without its notes."""
    table = _table(f"Table {made.number}. {made.title}.")
    groups = [name for name, width in made.groups for _ in range(width)]
    for heading in (made.first, "Method"):
        table.add_column(Text(heading))
    for k, heading in enumerate(made.columns):
        group = f"{groups[k]} " if groups else ""
        table.add_column(Text(one_line(f"{group}{heading}")), justify="right")
    for block in made.blocks:
        first = block.heading
        for row in block.rows:
            name = row.method if row.source == "ours" else f"{row.method} (paper)"
            cells = [f"{cell.shown}*" if cell.best else cell.shown for cell in row.cells]
            table.add_row(*(Text(one_line(text)) for text in (first, name, *cells)))
            first = ""
    return table


TITLES = {"none": "not moved", "rotation": "turned", "translation": "shifted", "both": "both"}


def stability_tables(report: dict[str, Any]) -> Iterator[Table]:
    """Per mode: changes under motion, a column per kind, and scatter over resamplings."""
    about = f"{report['method']} {report['category']} {report['data']['split']}"
    count = len(report["data"]["samples"])
    for mode, found in report["modes"].items():
        rate = f"{found['clouds_per_second']:.3g} a second"
        moved = found["equivariance"]
        table = _table(f"{about}, {mode}, {count} clouds, {rate}")
        for heading in ("change, median / p95", *(TITLES[kind] for kind in moved)):
            table.add_column(heading)
        for name in moved["both"]:
            table.add_row(quantity(name), *(_pair(rows[name]) for rows in moved.values()))
        yield table
        if "resampling" in found:
            yield _scatter_table(found["resampling"])


def _scatter_table(rows: dict[str, Any]) -> Table:
    table = Table("scatter", "std, median", "MAD, median", "MAD, p95", title="resampled")
    for name in dict.fromkeys(key.rsplit("_", 1)[0] for key in rows):
        std, mad = rows[f"{name}_std"], rows[f"{name}_mad"]
        table.add_row(quantity(name), _ranged(std, "median"), _ranged(mad, "median"),
                      _ranged(mad, "p95"))  # fmt: skip
    return table


def quantity(name: str) -> str:
    """`base_rotation_deg` as a reader takes it: base rotation, deg."""
    head, unit = name.replace("_", " ").rsplit(" ", 1)
    return head if unit == "1" else f"{head}, {unit}"


def _table(title: str) -> Table:
    return Table(title=Text(one_line(title, 200)))


def _number(value: float) -> str:
    return "<1e-3" if 0 < value < 1e-3 else f"{value:.3g}"


def _pair(row: dict[str, Any]) -> str:
    if "median" not in row:
        return "–"
    return f"{_number(row['median']['value'])} / {_number(row['p95']['value'])}"


def _ranged(row: dict[str, Any], key: str) -> str:
    if key not in row:
        return "–"
    low, high = _number(row[key]["low"]), _number(row[key]["high"])
    return f"{_number(row[key]['value'])} ({low} to {high})"
