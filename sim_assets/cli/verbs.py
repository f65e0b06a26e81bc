# SPDX-License-Identifier: MIT
"""The verbs of `scapo-data`: one dataclass each, whose fields are the flags.

A verb asks one function of its room, which is imported when it runs, and prints what came of it.
"""

from __future__ import annotations

import os
import threading
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from scapo.categories import CATEGORIES, Category
from scapo.ranges import CountOrNone, Port, Positive, Range, Seed
from scapo.text import UsageError, did_you_mean
from sim_assets.cli.console import progress_bar, say, say_each, show_made
from sim_assets.options import DataOptions

if TYPE_CHECKING:
    from sim_assets.generation.generate import Progress, Running

    CategoryName = str
else:
    CategoryName = Literal[tuple(CATEGORIES)]
NameOfAny = Annotated[str, tyro.conf.arg(metavar="{" + ",".join([*CATEGORIES, "..."]) + "}")]
"""One of the package's categories or of a file's."""
MOST_POINTS = 1 << 24
"""`scapo.store.manifest.MAX_POINTS`, written out: that module takes time to import."""


def find(name: str, file: Path | None) -> Category:
    """The category of this name, of the package or of a file of categories.

    Raises:
        UsageError: There is none.
        StoreError: The file is not what it should be.
    """
    from scapo.store.definitions import read_categories

    known = CATEGORIES if file is None else {**read_categories(file), **CATEGORIES}
    if name not in known:
        hint = "" if file else ", or one of your own with --categories FILE"
        raise UsageError(
            f"category {name!r}: expected one of {', '.join(known)}{hint}"
            f"{did_you_mean(name, known)}"
        )
    return known[name]


@dataclass(frozen=True, slots=True, kw_only=True)
class Doctor:
    """Say which renderers work here, and what supplies those that do not."""

    def run(self, console: Console) -> int:
        """Print the report; 0 where something renders."""
        from sim_assets.rendering.doctor import render, report

        found = report(lambda line: say(console, line))
        console.print(render(found))
        return 0 if found.backend else 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Build:
    """Write procedural assets as URDF and OBJ: OUT/CATEGORY/INSTANCE/mobility.urdf."""

    category: tyro.conf.Positional[CategoryName]
    """Category of the assets."""
    out: Path
    """Folder for the assets."""
    count: int = 10
    """Number of instances."""
    seed: Seed = 1
    """Seed of the shapes."""
    split: Literal["train", "val", "test", "test-ood"] = "train"
    """Split of the instances; splits share none."""

    def run(self, console: Console) -> int:
        """Write them, and print the folder."""
        from sim_assets.generation.build import build

        paths = build(
            self.category, count=self.count, seed=self.seed, out=self.out, split=self.split
        )
        with progress_bar(console) as show:
            for done, _ in enumerate(paths, 1):
                show("assets", done, self.count)
        say(console, f"{self.count} assets in {self.out / self.category}")
        return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """Say of each model of a folder whether it can be used: accepted, repaired or refused."""

    path: tyro.conf.Positional[Path]
    """Folder of models, searched recursively, or one .urdf file. URDFs beside a mobility.urdf
    count as variants of that model: name their file to have one checked."""
    json: Path | None = None
    """File that the results are written to as well."""
    category: NameOfAny | None = None
    """Category that the models must be of; default: some joint can be used."""
    categories: Path | None = None
    """Categories of your own, a TOML file (docs/categories.md)."""
    up: str | None = None
    """Axis of the URDF's root link that is up, such as z or -y."""
    front: str | None = None
    """Axis that the front faces."""
    scale: Positive | None = None
    """Scale: metres per unit of the URDF."""
    any_model: bool = False
    """Any model: with a category, accept also those none of whose names speaks of it."""
    workers: CountOrNone = os.cpu_count() or 1
    """Worker processes."""

    def run(self, console: Console) -> int:
        """Print one line per model; 1 if any is refused."""
        from sim_assets.inspect.check import Options, Result, check, exit_code, write_report

        colors = {"accepted": "green", "repaired": "yellow", "refused": "red"}

        def show(result: Result) -> None:
            why = result.reason or "; ".join(result.account or result.repairs)
            style = colors[result.status]
            say(console, f"{result.path}  {why}", label=f"{result.status:8} ", style=style)

        options = Options(
            category=None if self.category is None else find(self.category, self.categories),
            up=self.up,
            front=self.front,
            scale=self.scale,
            any_model=self.any_model,
        )
        results = check(self.path, options, workers=self.workers, on_result=show)
        if self.json is not None:
            write_report(results, self.json)
        counts = {name: sum(r.status == name for r in results) for name in colors}
        say(console, ", ".join(f"{count} {name}" for name, count in counts.items()))
        return exit_code(results)


@dataclass(frozen=True, slots=True, kw_only=True)
class Workers:
    """The flags of who makes data, which change no byte of them."""

    workers: CountOrNone | None = None
    """Worker processes; by default as many as pay, one per core at most, and one at least for
    models of a folder. 0: work in this process, unprotected against objects that crash or hang."""
    engine: Literal["local", "ray"] = "local"
    """Where the workers run: on this machine, or on the Ray cluster of RAY_ADDRESS
    (docs/cluster.md)."""
    timeout: Positive = 300.0
    """Seconds without a sign of life after which an object counts as hanging and is left out."""
    strict: bool = False
    """Stop at the first object that fails."""

    def running(self, show: Progress) -> Running:
        """The same with who is told of progress."""
        from sim_assets.generation.generate import Running

        return Running(**asdict(self), progress=show)


@dataclass(frozen=True, slots=True, kw_only=True)
class Generate:
    """Make labelled point clouds: OUT/CATEGORY/SPLIT/manifest.json and shards.

    Started again after an interruption it goes on; the bytes are the same either way.
    """

    category: tyro.conf.Positional[NameOfAny]
    """Category of the objects; one of your own with --categories."""
    out: Path
    """Folder of the data set."""
    categories: Path | None = None
    """Categories of your own, a TOML file (docs/categories.md); it takes --source with models. The
    data carry the definition, so that no later command asks for the file."""
    data: Annotated[DataOptions, tyro.conf.arg(name="")] = field(default_factory=DataOptions)
    how: Annotated[Workers, tyro.conf.arg(name="")] = field(default_factory=Workers)

    def run(self, console: Console) -> int:
        """Make them, print a summary, and name the objects that failed."""
        from sim_assets.generation.generate import make_split
        from sim_assets.models.library import undivided

        started, kind = time.monotonic(), find(self.category, self.categories)
        with progress_bar(console) as show:
            running = self.how.running(show)
            made = make_split(kind, self.data, self.out, running)
        show_made(console, made, time.monotonic() - started)
        own = self.data.source != "procedural"
        if own and (few := undivided(Path(self.data.source))):
            say(console, f"note: too few models to divide ({few}): every split shows all of them, "
                         "and scores say how well these are known, not others")  # fmt: skip
        return 1 if made.failed else 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Benchmark:
    """Make the data of a benchmark: OUT/PART/CATEGORY/SPLIT, and a record of time, size and digest.

    Started again after an interruption it goes on; the bytes are the same either way.
    """

    name: tyro.conf.Positional[Literal["sim-art/2", "sim-art/1"]]
    """Name of the benchmark: 117,000 samples of the nine categories, about 1.6 GB
    (docs/benchmark.md). sim-art/1, its predecessor, is made by an older commit, which is named."""
    out: Path
    """Folder of the benchmark."""
    only: tuple[str, ...] = ()
    """Only these pieces: parts (clean, sensor, complete, real), categories, splits, or several
    joined by /, such as sensor/laptop/train."""
    real: Path | None = None
    """Real models of yours, PATH/CATEGORY/ID/*.urdf: adds OUT/real/CATEGORY/test, 20 views of each.
    Their category is told by PATH/index.csv, by themselves, or by the folder."""
    backend: Literal["auto", "sapien", "raycast"] = "sapien"
    """Renderer; the published digests are SAPIEN's."""
    how: Annotated[Workers, tyro.conf.arg(name="")] = field(default_factory=Workers)

    def run(self, console: Console) -> int:
        """Make them, print a summary of each split, and name the objects that failed."""
        from sim_assets.generation.benchmark import (
            RECORD,
            Task,
            check_name,
            find_real,
            make_benchmark,
            pieces,
        )

        check_name(self.name)
        task = Task(only=self.only, backend=self.backend, real=self.real)
        real = find_real(task)
        total, failed = len(pieces(self.only, real)), False
        others = {} if real is None else real.others
        say_each(console, others, label="no category", style="yellow")
        with progress_bar(console) as show:
            running = self.how.running(show)
            made = make_benchmark(self.out, task, running)
            for number, done in enumerate(made, 1):
                say(console, f"{number}/{total} {done.piece.name}")
                show_made(console, done.made, done.seconds)
                failed |= bool(done.made.failed)
        say(console, f"recorded in {self.out / RECORD}")
        return 1 if failed else 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Import:
    """Bring an external data set into this project's layout: clouds as splits, models as URDF.

    Clouds: OUT/CATEGORY/SPLIT/manifest.json and shards. Models: OUT/CATEGORY/ID/mobility.urdf, for
    `generate --source OUT/CATEGORY`.
    """

    name: tyro.conf.Positional[
        Literal["op-align-real", "op-align-light", "shape2motion", "hoi4d", "partnet-mobility"]
    ]
    """Name of the set."""
    path: tyro.conf.Positional[Path]
    """Folder of the set, or one above or within it."""
    out: Path
    """Folder for what is made."""
    points: Annotated[int, Range(1, MOST_POINTS)] = 1024
    """Points of a cloud; drawn with replacement where a file has fewer."""
    strict: bool = False
    """Stop at the first file that cannot be used."""

    def run(self, console: Console) -> int:
        """Import it, and name what could not be used; 1 if there is any."""
        from sim_assets.importers.sets import Reading, import_set

        with progress_bar(console) as show:
            made = import_set(
                self.name,
                self.path,
                self.out,
                points=self.points,
                strict=self.strict,
                reading=Reading(workers=1, progress=show),
            )
        notes = {model: "; ".join(several) for model, several in made.notes.items()}
        say_each(console, notes, label="repaired", style="yellow")
        say_each(console, made.refused, label="left out", style="red")
        what = f"{made.samples} clouds in {len(made.written)} splits"
        if not made.samples:
            what = f"{len(made.written)} models"
        say(console, f"{what} in {self.out}, {len(made.refused)} left out")
        return 1 if made.refused or not made.written else 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Info:
    """Say what a data set holds, how much its objects differ, and whether its shards are whole."""

    path: tyro.conf.Positional[Path]
    """A data set, or a category or split of one."""
    source: Path | None = None
    """Source of the objects: the folder of models that the set was made from, to measure them."""

    def run(self, console: Console) -> int:
        """Print counts, histograms and digests of every split, the damaged among them.

        Raises:
            StoreError: What is wrong with the first split that is damaged, and how many are.
        """
        from scapo.store import Split, StoreError
        from sim_assets.describe.info import describe_split, find_splits
        from sim_assets.inspect.variation import Variation

        damaged, variation = list[str](), Variation(self.source)
        folders = find_splits(self.path)
        for folder in folders:
            try:
                split = Split(folder)
            except StoreError as error:
                say(console, error, label="DAMAGED", style="red")
                damaged.append(str(error))
                continue
            report = describe_split(split)
            lines = [report.text, *variation.lines(split)]
            console.print("\n".join(lines), soft_wrap=True, highlight=False, markup=False)
            damaged += [report.damage] if report.damage else []
        if damaged:
            raise StoreError(f"{damaged[0]} ({len(damaged)} of {len(folders)} splits are damaged)")
        return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """Show a data set in the browser: clouds by part, joint axes, the object; Ctrl-C ends it."""

    path: tyro.conf.Positional[Path]
    """A data set, or a category or split of one."""
    port: Port = 8080
    """Port to listen at; the next free one is taken if it is in use."""
    host: str = "localhost"
    """Address to listen at; 0.0.0.0 lets other machines in."""
    source: Path | None = None
    """Folder of the models that the data set was made from, to show their meshes."""
    predictions: Path | None = None
    """Predictions of one of its splits, to show beside the truth: axes in orange, points by
    predicted part."""

    def run(self, console: Console) -> int:
        """Serve until interrupted."""
        from sim_assets.inspect.view import Viewer

        viewer = Viewer(self.path, self.source, self.host, self.port, self.predictions)
        try:
            say(console, f"{viewer.url} (Ctrl-C ends it)")
            threading.Event().wait()
        except KeyboardInterrupt:
            say(console, "ended")
        finally:
            viewer.close()
        return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Preview:
    """Draw samples of a data set as one picture: clouds by part, with joint axes."""

    path: tyro.conf.Positional[Path]
    """A data set, or a category or split of one."""
    out: Path
    """File of the picture, FILE.png."""
    count: int = 24
    """Number of samples of each split, spread evenly."""
    category: str | None = None
    """Category to draw; default: all."""
    split: str | None = None
    """Split to draw; default: all."""
    by_ambiguity: bool = False
    """Draw half of them of samples that look alike under other turns, half of others, apart; for
    data made with --ambiguity."""

    def run(self, console: Console) -> int:
        """Draw it."""
        from sim_assets.inspect.preview import draw_preview

        drawn = draw_preview(
            self.path,
            self.out,
            self.count,
            self.category,
            self.split,
            by_ambiguity=self.by_ambiguity,
        )
        say(console, f"{drawn} samples drawn in {self.out}")
        return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Actuate:
    """Does it open: pull the true object, in SAPIEN, along the path that a predicted joint implies.

    A compliant hand holds the part's free edge; docs/actuate.md says what is measured.
    """

    predictions: tyro.conf.Positional[Path]
    """Predictions (safetensors, docs/bring-your-own-method.md)."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""
    out: Path
    """File of the results, FILE.csv: one row per sample and joint; `scapo-bench tables` reads it
    where it lies beside scores."""
    source: Path | None = None
    """Source of the objects: the folder of models that the set was made from."""
    limit: int | None = None
    """Try only the first so many samples."""
    workers: CountOrNone | None = None
    """Worker processes; by default one per core. 0: work in this process."""

    def run(self, console: Console) -> int:
        """Pull, print how many moved far enough, and name the objects that were left out."""
        from sim_assets.actuation.actuate import actuate, left_out, summary
        from sim_assets.generation.generate import Running

        with progress_bar(console) as show:
            rows = actuate(
                self.predictions,
                self.data,
                self.out,
                source=self.source,
                limit=self.limit,
                running=Running(workers=self.workers, progress=show),
            )
        for line in summary(rows):
            say(console, line)
        failed = left_out(rows)
        say_each(console, failed, label="left out", style="red")
        say(console, f"Results: {self.out}")
        return 1 if failed else 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Export:
    """Write a data set in a format that is read without this package.

    OUT gets the same folders, with the manifest, the card and a file for each shard. It appears
    whole, and replaces only an earlier export.
    """

    path: tyro.conf.Positional[Path]
    """A data set, or a category or split of one."""
    format: Literal["webdataset", "parquet", "npz"]
    """Format. webdataset: tar files with one .npy for each tensor of a sample. parquet: a row for
    each sample (needs pyarrow: pip install 'scapo[export]'). npz: stacked arrays."""
    out: Path
    """Folder to write."""

    def run(self, console: Console) -> int:
        """Write it, and print what was written."""
        from sim_assets.describe.info import find_splits
        from sim_assets.formats.export import export

        for done in export(self.path, find_splits(self.path), self.out, self.format):
            say(console, f"{done.name}: {done.samples} samples in {done.files} files")
        say(console, f"written to {self.out}")
        return 0


VERBS: dict[str, type] = {
    "doctor": Doctor,
    "build": Build,
    "check": Check,
    "generate": Generate,
    "benchmark": Benchmark,
    "import": Import,
    "info": Info,
    "view": View,
    "preview": Preview,
    "export": Export,
    "actuate": Actuate,
}
"""In the order of the help."""
