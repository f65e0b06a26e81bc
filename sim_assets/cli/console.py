# SPDX-License-Identifier: MIT
"""What `scapo-data` prints while it works and when it is done."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console
from rich.markup import escape
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

if TYPE_CHECKING:
    from sim_assets.generation.generate import Made

Item = TypeVar("Item")


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


def watched(console: Console, what: str, items: Iterable[Item], total: int) -> Iterator[Item]:
    """The items, with a bar."""
    with progress_bar(console) as show:
        show(what, 0, total)
        for done, item in enumerate(items, 1):
            yield item
            show(what, done, total)


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
    lines = [
        f"{manifest.category}/{manifest.split}: {size}, {how}",
        f"views redrawn: {100 * facts.get('redrawn_share', 0):.2f} %",
        f"digest {manifest.digest}",
        f"plan   {manifest.plan_digest}",
        f"folder {made.folder}",
    ]
    console.print("\n".join(map(escape, lines)), highlight=False, soft_wrap=True)
    for instance in manifest.instances:
        if instance.account:
            line = f"[green]taken[/] {escape(instance.id)}: {escape('; '.join(instance.account))}"
            console.print(line, highlight=False, soft_wrap=True)
    show_left_out(console, made.failed)
    lost = int(facts.get("samples_lost", 0))
    if lost:
        console.print(f"{lost} samples were lost with them", highlight=False)


def show_left_out(console: Console, reasons: Mapping[str, str], what: str = "left out") -> None:
    """One line for each object that is not there, with the reason."""
    for name, reason in reasons.items():
        line = f"[red]{what}[/] {escape(name)}: {escape(reason)}"
        console.print(line, highlight=False, soft_wrap=True)
