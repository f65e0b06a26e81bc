# SPDX-License-Identifier: MIT
"""`make demo`: the whole idea, by the commands that a user would type.

Renders fresh objects of the categories that have released models, predicts, scores, and prints
Table 1 with the paper's numbers beside ours; turns one depth image of each into joints, a URDF and
a page with sliders. `make demo-train` trains from scratch instead (`--methods`). Pictures and logs
go to `results/demo/`. Two categories run side by side, one process each. A second run goes on from
the first: data and finished runs stay.
"""

from __future__ import annotations

from scapo.interrupt import exit_interrupted, quit_at_interrupt

with quit_at_interrupt("demo"):  # these take a second
    import csv
    import shutil
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
    from scapo.released import find, released

RELEASED = "released"
CURVED = ("scapo", "registered")
"""Methods whose training has a curve."""
PRINTED = ("SCAPO", "ICP")
METRICS = ("S", "D", "C", "R", "t")
BESIDE = ("Constant prediction", "Oracle pose", "one part order")
"""Rows that the tables have beside those of methods; the demo's table leaves them out."""
PICTURED = 8
TABLE1 = ("laptop", "safe", "eyeglasses", "oven", "washer")
VIEWS = 3  # Of each object that released models are asked about
AT_ONCE = 2  # Categories that run side by side


@dataclass(frozen=True)
class Demo:
    """Render, predict, score, draw, and take joints from single views."""

    out: Path = Path("results/demo")
    """Folder for data, runs, scores, tables, pictures and logs."""
    categories: tuple[str, ...] = ()
    """Categories to run; those of Table 1 with a released model where none is named."""
    train: int = 60
    """Training clouds per category, for `methods` and the constant answer beside them."""
    test: int = 60
    """Test clouds per category."""
    methods: tuple[Literal["scapo", "registered", "icp"], ...] = ()
    """Methods that are trained from scratch; the released models answer where none is named."""
    epochs: int = 16
    """Passes over the training clouds in each of the two stages of SCAPO as published."""
    votes: int = 30
    """Passes of the network of template registration, once its template is found."""

    def __post_init__(self) -> None:
        """Take the categories of Table 1 that have released models where none is named."""
        if not self.categories:
            there = released()
            named = tuple(name for name in TABLE1 if name in there)
            object.__setattr__(self, "categories", named or TABLE1[:1])


def main() -> None:
    """Run the demo; exit 1 when a step fails."""
    console = Console(highlight=False)
    started = time.perf_counter()
    try:
        demo = tyro.cli(Demo, prog="python -m bench.demo", description=__doc__)
        console.print(f"scapo demo: {', '.join(demo.categories)} -> {demo.out}/")
        with ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(lambda name: run_category(demo, name, console), demo.categories))
        table = make_table(demo, console)
    except (StepError, store.StoreError) as error:
        console.print(f"demo: {error}", style="red")
        raise SystemExit(1) from error
    except KeyboardInterrupt:
        exit_interrupted("demo: interrupted; run it again to go on from here")
    console.print(table)
    console.print(closing_words(demo, time.perf_counter() - started), soft_wrap=True)


def run_category(demo: Demo, category: str, console: Console) -> None:
    """Data, models, predictions, scores and pictures of one category."""
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
    if not demo.methods:
        score(demo, steps, RELEASED, find(category))
        take_joints(demo, steps)
    draw(demo, category)


def take_joints(demo: Demo, steps: Steps) -> None:
    """The first test view's depth image, mask and camera, and what `infer` makes of them."""
    shown = demo.out / "data" / steps.category / "test" / "images" / "00000"
    scan = demo.out / "scans" / steps.category
    scan.parent.mkdir(parents=True, exist_ok=True)
    files = {"0000.png": ".png", "0000.mask.png": ".mask.png", "intrinsics.json": ".json"}
    depth, mask, camera = (
        shutil.copyfile(shown / name, f"{scan}{suffix}") for name, suffix in files.items()
    )
    steps.bench(
        "infer", depth, "--mask", mask, "--intrinsics", camera, "--category", steps.category,
        "--out", str(demo.out / "twins"),
    )  # fmt: skip


def score(demo: Demo, steps: Steps, method: str, run: Path) -> None:
    """Predict and evaluate; models know the object's frame from their training."""
    data = str(demo.out / "data")
    name = f"{steps.category}-{method}"
    test = str(demo.out / "predictions" / f"{name}-test.safetensors")
    mode = ["--mode", "refine"] if method in ("registered", RELEASED) else []
    steps.bench("predict", str(run), "--data", data, "--split", "test", *mode, "--out", test)
    scores = str(demo.out / "scores" / f"{name}.csv.gz")
    steps.bench("evaluate", "--predictions", test, "--data", data, "--out", scores)


def make_data(demo: Demo, steps: Steps, data: str) -> None:
    """Both splits, and a contact sheet of the test split."""
    category = steps.category
    for split, count in (("train", demo.train), ("test", demo.test)):
        each = VIEWS if not demo.methods else 16 if split == "train" else 10
        instances = max(1, count // each)
        images = ["--images"] if split == "test" and not demo.methods else []
        steps.data(
            "generate", category, "--out", data, "--split", split, "--count", str(count),
            "--instances", str(instances), "--workers", "1", *images,
        )  # fmt: skip
    sheet = demo.out / "pictures" / f"{category}-data.png"
    steps.data("preview", f"{data}/{category}/test", "--out", str(sheet))


def draw(demo: Demo, category: str) -> None:
    """The training curve and test predictions, evenly spread over the test split."""
    for method in demo.methods:
        curve = demo.out / "runs" / f"{category}-{method}" / "metrics.jsonl"
        if method in CURVED:
            name = "training" if method == "scapo" else f"{method}-training"
            training_curve(curve, demo.out / "pictures" / f"{category}-{name}.png")
    split = store.open_split(demo.out / "data", category, "test")
    samples = range(0, split.manifest.count, max(1, split.manifest.count // PICTURED))
    for method in demo.methods or (RELEASED,):
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
    """Our rows, by method alone, and the paper's SCAPO and ICP, for the demo's categories."""
    columns = [name.capitalize() for name in demo.categories]
    table = Table("metric", "method", *columns, title="Table 1, the demo's part")
    rows: dict[str, dict[str, dict[str, str]]] = {}
    for cell in cells:
        shown = cell["method"] in PRINTED if cell["source"] == "paper" else answers(cell["method"])
        shown = shown and cell["block"].split()[0] in METRICS
        if shown and cell["value"] and cell["column"] in columns:
            method = f"{cell['method'].partition(' (')[0]}, {cell['source']}"
            values = rows.setdefault(cell["block"], {}).setdefault(method, {})
            values[cell["column"]] = cell_text(float(cell["value"]))
    for block, methods in rows.items():
        for number, (method, values) in enumerate(methods.items()):
            texts = [values.get(column, "–") for column in columns]
            table.add_row("" if number else block, method, *texts)
        table.add_section()
    return table


def answers(method: str) -> bool:
    """Whether a row of ours is a method's best: no reference, and not scored a second way."""
    return not any(words in method for words in BESIDE)


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
    trained = f"trained from scratch on {demo.train} clouds: {', '.join(demo.methods)}"
    models = trained if demo.methods else "answered by the released models"
    twins = f"""
  twins     {demo.out}/twins/NAME/  of one depth image each ({demo.out}/scans/NAME.png):
            joints.json, a URDF for simulators, a GLB, and a page with a slider for each joint
            (open it in a browser)"""
    if demo.methods:
        twins = ""
    return f"""
Done in {seconds / 60:.1f} minutes: {demo.test} fresh clouds of each category rendered, {models},
and scored.

  tables    {demo.out}/tables/
  pictures  {demo.out}/pictures/  data, predictions (parts coloured, axes drawn){twins}
  logs      {demo.out}/logs/

Next: your own depth image or cloud (scapo-bench infer FILE --category oven --out DIR), train one
yourself (make demo-train, or README, "The four steps of a benchmark"), your own models (scapo-data
check PATH), or your own method (docs/bring-your-own-method.md)."""


if __name__ == "__main__":
    main()
