# SPDX-License-Identifier: MIT
"""`make demo`: the whole idea on two categories, by the commands that a user would type.

Renders laptops and ovens, trains SCAPO briefly without labels, registers the ICP baseline, scores
both and prints Table 1 with the paper's numbers beside ours. Pictures and logs go to
`results/demo/`. The two categories run side by side, one process each. A second run goes on from
the first: data and finished runs stay.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.table import Table

from bench.figures.pictures import predictions_picture, training_curve
from bench.grid.command import Program, StepError, run_command
from scapo import store

CALIBRATED = ("scapo", "registered")
"""Methods that learn without poses: the evaluator fits their part frames on training clouds."""
PRINTED = ("SCAPO", "ICP")
PICTURED = 8


@dataclass(frozen=True)
class Demo:
    """Generate, train, predict, score, and draw two categories."""

    out: Path = Path("results/demo")
    """Folder for data, runs, scores, tables, pictures and logs."""
    categories: tuple[str, ...] = ("laptop", "oven")
    """Categories to run, side by side."""
    train: int = 640
    """Training clouds per category."""
    test: int = 200
    """Test clouds per category."""
    methods: tuple[Literal["scapo", "registered", "icp"], ...] = ("scapo", "icp")
    """SCAPO as published, SCAPO by registration and joint fit (ten minutes more), and ICP."""
    epochs: int = 16
    """Passes over the training clouds in each of the two stages of SCAPO as published."""
    votes: int = 30
    """Passes of the network of SCAPO by registration, after registration and joint fit."""


def main() -> None:
    """Run the demo; exit 1 when a step fails."""
    demo = tyro.cli(Demo, prog="python -m bench.demo", description=__doc__)
    console = Console(highlight=False)
    started = time.perf_counter()
    console.print(f"scapo demo: {', '.join(demo.categories)} -> {demo.out}/")
    try:
        with ThreadPoolExecutor(len(demo.categories)) as pool:
            list(pool.map(lambda name: run_category(demo, name, console), demo.categories))
        table = make_table(demo, console)
    except (StepError, store.StoreError) as error:
        console.print(f"demo: {error}", style="red")
        raise SystemExit(1) from error
    except KeyboardInterrupt:
        console.print("demo: interrupted; run it again to go on from here")
        raise SystemExit(130) from None
    console.print(table)
    console.print(closing_words(demo, time.perf_counter() - started), soft_wrap=True)


def run_category(demo: Demo, category: str, console: Console) -> None:
    """Data, training, predictions, scores and pictures of one category."""
    steps = Steps(demo.out, category, console)
    data = str(demo.out / "data")
    make_data(demo, steps, data)
    flags = {
        "scapo": ["--preset", "cpu", "--epochs", str(demo.epochs)],
        "registered": ["--epochs", str(demo.votes)],
    }
    for method in demo.methods:
        run = demo.out / "runs" / f"{category}-{method}"
        steps.bench(
            "train", method, "--category", category, "--data", data, "--out", str(run),
            "--resume", *flags.get(method, []),
        )  # fmt: skip
        score(demo, steps, method, run)
    draw(demo, category)


def score(demo: Demo, steps: Steps, method: str, run: Path) -> None:
    """Predict and evaluate; what trained without poses has its frames fitted on training clouds."""
    data = str(demo.out / "data")
    name = f"{steps.category}-{method}"
    test = str(demo.out / "predictions" / f"{name}-test.safetensors")
    steps.bench("predict", str(run), "--data", data, "--split", "test", "--out", test)
    calibration: list[str] = []
    if method in CALIBRATED:
        train = str(demo.out / "predictions" / f"{name}-train.safetensors")
        steps.bench("predict", str(run), "--data", data, "--split", "train", "--out", train)
        calibration = ["--calibration", train]
    scores = str(demo.out / "scores" / f"{name}.csv.gz")
    steps.bench("evaluate", "--predictions", test, *calibration, "--data", data, "--out", scores)


def make_data(demo: Demo, steps: Steps, data: str) -> None:
    """Both splits, and a contact sheet of the test split."""
    category = steps.category
    for split, count in (("train", demo.train), ("test", demo.test)):
        instances = max(1, count // (16 if split == "train" else 10))
        steps.data(
            "generate", category, "--out", data, "--split", split, "--count", str(count),
            "--instances", str(instances), "--workers", "1",
        )  # fmt: skip
    sheet = demo.out / "pictures" / f"{category}-data.png"
    steps.data("preview", f"{data}/{category}/test", "--out", str(sheet))


def draw(demo: Demo, category: str) -> None:
    """The training curve and test predictions, evenly spread over the test split."""
    for method in demo.methods:
        curve = demo.out / "runs" / f"{category}-{method}" / "metrics.jsonl"
        if method in CALIBRATED:
            name = "training" if method == "scapo" else f"{method}-training"
            training_curve(curve, demo.out / "pictures" / f"{category}-{name}.png")
    split = store.open_split(demo.out / "data", category, "test")
    samples = range(0, split.manifest.count, max(1, split.manifest.count // PICTURED))
    for method in demo.methods:
        predictions_picture(
            split,
            demo.out / "predictions" / f"{category}-{method}-test.safetensors",
            demo.out / "pictures" / f"{category}-{method}.png",
            list(samples)[:PICTURED],
        )


def make_table(demo: Demo, console: Console) -> Table:
    """Table 1 from the scores; what is printed is its part on the demo's categories."""
    steps = Steps(demo.out, "tables", console)
    steps.bench("tables", "--scores", str(demo.out / "scores"), "--out", str(demo.out / "tables"))
    with (demo.out / "tables" / "table1.csv").open(newline="") as file:
        return summary(demo, list(csv.DictReader(file)))


def summary(demo: Demo, cells: Sequence[Mapping[str, str]]) -> Table:
    """Our rows and the paper's SCAPO and ICP, for the demo's categories."""
    columns = [name.capitalize() for name in demo.categories]
    table = Table("metric", "method", *columns, title="Table 1, the demo's part")
    rows: dict[str, dict[str, dict[str, str]]] = {}
    for cell in cells:
        shown = cell["source"] == "ours" or cell["method"] in PRINTED
        if shown and cell["value"] and cell["column"] in columns:
            method = f"{cell['method']}, {cell['source']}"
            values = rows.setdefault(cell["block"], {}).setdefault(method, {})
            values[cell["column"]] = cell_text(float(cell["value"]))
    for block, methods in rows.items():
        for number, (method, values) in enumerate(methods.items()):
            texts = [values.get(column, "–") for column in columns]
            table.add_row("" if number else block, method, *texts)
        table.add_section()
    return table


def cell_text(value: float) -> str:
    """Two digits behind the point, three for lengths, whose values are small."""
    return f"{value:.{3 if abs(value) < 1 else 2}f}"


class Steps:
    """Runs commands one after the other, timed, each with its own log file."""

    def __init__(self, out: Path, category: str, console: Console) -> None:
        """Logs go to `out/logs`."""
        self.out, self.category, self.console, self.number = out, category, console, 0

    def data(self, *arguments: str) -> None:
        """A `scapo-data` command."""
        self._run("scapo-data", arguments)

    def bench(self, *arguments: str) -> None:
        """A `scapo-bench` command."""
        self._run("scapo-bench", arguments)

    def _run(self, program: Program, arguments: tuple[str, ...]) -> None:
        """Run, and say how long it took.

        Raises:
            StepError: The command ended with another status than 0.
        """
        self.number += 1
        log = self.out / "logs" / f"{self.category}-{self.number:02}-{arguments[0]}.txt"
        seconds = run_command(program, arguments, log)
        self.console.print(f"{seconds:6.1f} s  {program} {' '.join(arguments)}", soft_wrap=True)


def closing_words(demo: Demo, seconds: float) -> str:
    """What was done, where it lies, and what to do next."""
    return f"""
Done in {seconds / 60:.1f} minutes: {demo.train} training and {demo.test} test clouds of each
category rendered; SCAPO trained on the training clouds, far fewer than the benchmark's, without
labels, {demo.epochs} epochs a stage; ICP registered against five labelled training shapes; all
scored on the test clouds. On partial views the paper's method needs more than this:
--methods registered is the variant made for them (results/EXPERIMENTS.md).

  tables    {demo.out}/tables/
  pictures  {demo.out}/pictures/  data, training curves, predictions (parts coloured, axes drawn)
  logs      {demo.out}/logs/

Next: more data and a longer run (README, "The four steps of real use"), your own models
(scapo-data check PATH), or your own method (docs/bring-your-own-method.md)."""


if __name__ == "__main__":
    main()
