# SPDX-License-Identifier: MIT
"""The verb `scapo-data import`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.markup import escape

from sim_assets.console import progress_bar


@dataclass(frozen=True, slots=True, kw_only=True)
class Import:
    """Bring an external data set into this project's layout: clouds as splits, models as URDF.

    Clouds: OUT/CATEGORY/SPLIT/manifest.json and shards. Models: OUT/CATEGORY/ID/mobility.urdf, for
    `generate --source OUT/CATEGORY`.
    """

    name: tyro.conf.Positional[
        Literal["op-align-real", "op-align-light", "shape2motion", "hoi4d", "partnet-mobility"]
    ]
    """The set."""
    path: tyro.conf.Positional[Path]
    """Its folder, or one above or within it."""
    out: Path
    """Folder for what is made."""
    points: int = 1024
    """Clouds: points of a sample; drawn with replacement where a file has fewer."""
    strict: bool = False
    """Stop at the first file that cannot be used."""

    def run(self, console: Console) -> int:
        """Import it, and name what could not be used; 1 if there is any."""
        from sim_assets.importing import import_set

        with progress_bar(console) as show:
            made = import_set(
                self.name,
                self.path,
                self.out,
                points=self.points,
                strict=self.strict,
                progress=show,
            )
        for model, notes in made.notes.items():
            line = f"[yellow]repaired[/] {escape(model)}: {escape('; '.join(notes))}"
            console.print(line, highlight=False, soft_wrap=True)
        for what, reason in made.refused.items():
            line = f"[red]left out[/] {escape(what)}: {escape(reason)}"
            console.print(line, highlight=False, soft_wrap=True)
        what = f"{made.samples} clouds in {len(made.written)} splits"
        if not made.samples:
            what = f"{len(made.written)} models"
        line = f"{what} in {self.out}, {len(made.refused)} left out"
        console.print(line, highlight=False, soft_wrap=True)
        return 1 if made.refused or not made.written else 0
