# SPDX-License-Identifier: MIT
"""What `scapo-data` prints while it works and when it is done.

Names and reasons come from files of anybody: they are shown as they are, on one line, never obeyed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from scapo.text import one_line

if TYPE_CHECKING:
    from sim_assets.generation.generate import Made


def say(console: Console, line: object, *, label: str = "", style: str = "") -> None:
    """One line, however long, with a coloured word before it."""
    text = Text.assemble((f"{label} " if label else "", style), one_line(line))
    console.print(text, highlight=False, soft_wrap=True)


def say_each(console: Console, reasons: Mapping[str, str], *, label: str, style: str) -> None:
    """One line for each name, with its reason."""
    for name, reason in reasons.items():
        say(console, f"{name}: {reason}", label=label, style=style)


class RateColumn(ProgressColumn):
    """Steps per second."""

    def render(self, task: Task) -> Text:
        """The recent rate."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.0f}/s", style="progress.data.speed")


@contextmanager
def progress_bar(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """A function show(what, done, total) that draws one bar per `what`; silent off a terminal."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        RateColumn(),
        TimeRemainingColumn(),
    )
    bars: dict[str, TaskID] = {}
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:

        def show(what: str, done: int, total: int) -> None:
            if what not in bars:
                bars[what] = progress.add_task(what, total=total)
            progress.update(bars[what], completed=done, total=total)

        yield show


def show_made(console: Console, made: Made, seconds: float) -> None:
    """Summary of a data set, then one line for each object that failed."""
    manifest = made.manifest
    facts = manifest.statistics
    size = f"{manifest.count} samples of {len(manifest.instances)} objects"
    if made.kept == len(manifest.shards):
        how = "there already, whole"
    else:
        again = f", {made.kept} shards were there" if made.kept else ""
        how = f"{seconds:.1f} s{again}"
    say(console, f"{manifest.category}/{manifest.split}: {size}, {how}")
    say(console, f"views redrawn: {100 * facts.get('redrawn_share', 0):.2f} %")
    say(console, f"digest {manifest.digest}")
    say(console, f"plan   {manifest.plan_digest}")
    say(console, f"folder {made.folder}")
    read = {i.id: "; ".join(i.account) for i in manifest.instances if i.account}
    say_each(console, read, label="taken", style="green")
    say_each(console, made.failed, label="left out", style="red")
    lost = int(facts.get("samples_lost", 0))
    if lost:
        say(console, f"{lost} samples were lost with them")
