# SPDX-License-Identifier: MIT
"""The verbs of `scapo-bench`: one dataclass each, whose fields are the flags.

A verb asks one function of its room, which is imported only then, and prints the answer.
"""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Union

import tyro
from rich.console import Console

from bench import requests
from bench.cli.console import (
    chain_line,
    in_words,
    results_table,
    say,
    shown,
    stability_tables,
    stage_bars,
    summary_table,
    watched,
)
from bench.metrics import ApRule


@dataclass(frozen=True, slots=True, kw_only=True)
class Train(requests.TrainRequest[requests.M]):
    """Fit a method to one category; the run folder keeps config, log, curve and checkpoint."""

    def run(self, console: Console) -> None:
        """Fit it, with a progress bar, and name checkpoint and report."""
        from bench.runs.train import train

        with stage_bars(console) as listener:
            written = train(self, lambda line: say(console, line), listener)
        if written is not None:
            say(console, f"Run: {', '.join(map(str, written))}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Predict(requests.PredictRequest):
    """Predict parts, poses and joints of every cloud of a split."""

    def run(self, console: Console) -> None:
        """Write the file, and say how long a cloud took."""
        from bench.runs.predict import predict

        count, seconds = predict(self, watched(console, "predict"))
        say(console, f"{count} clouds, {1000 * seconds:.1f} ms each: {self.out}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluate(requests.EvaluateRequest):
    """Score a predictions file, written by any program, against the data it was made on."""

    def run(self, console: Console) -> None:
        """Score and print the means."""
        from bench.analysis.beside import evaluate_beside
        from bench.scoring.score_files import side_file

        report, beside = evaluate_beside(self)
        if self.calibration is None and (at := report["calibration"]) is not None:
            say(console, f"Calibrated at training, on {at['samples']} clouds of {at['split']}.")
        elif self.calibration is None and "pose" not in report["supervision"]:
            say(console, "No --calibration: part poses are compared as given.")
        console.print(summary_table(report))
        say(console, f"Scores: {self.out}")
        say(console, f"Report: {side_file(self.out)}")
        for path in beside:
            say(console, f"Beside it: {path}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Tables:
    """Tables 1 to 7 from scores per sample; 1 to 3 have the paper's printed numbers beside ours.

    Table 1 is on single views (clean), 1-complete on whole surfaces, 1b on parts seen alone
    (isolated), 4 has mean errors on sensor data and on further categories, 5 real models, 6 objects
    unlike those of training by what sets them apart (test-ood), 7 what `scapo-data actuate` found.
    """

    scores: Path = Path("results/scores")
    """Folder with NAME.csv.gz files and those of `scapo-data actuate`, searched through."""
    out: Path = Path("results/tables")
    """Folder for table{1,1-complete,1b,2,3,4,5,6,7}.{md,csv,tex} and significance.csv."""
    split: str = "test"
    """Split of all tables but 6, which has test-ood beside it."""
    ap_rule: ApRule = "mean"
    """How the parts of a sample join in the average precision of Table 2."""
    html: bool = False
    """Also write index.html: the tables as a leaderboard that a browser opens from disk."""
    only_ours: bool = False
    """Only our rows, without the paper's printed numbers."""
    check_paper: bool = False
    """Only list what does not add up in the paper's printed tables; writes nothing."""

    def run(self, console: Console) -> None:
        """Write the tables and print those that have rows of ours, or check the printed ones."""
        from bench.tables.paper import check
        from bench.tables.write import make_tables

        if self.check_paper:
            lines: list[object] = [*check()]
        else:
            made = make_tables(self.scores, self.ap_rule, self.split, only_ours=self.only_ours)
            lines = [*made.write(self.out, page=self.html)]
            for table in made.with_ours():
                console.print(results_table(table))
        for line in lines:
            say(console, line)


@dataclass(frozen=True, slots=True, kw_only=True)
class Explain(requests.Request):
    """Why a method fails: errors by what was seen, and with one piece replaced by the truth."""

    out: Path
    """Folder for ladder.md, ladder.csv, ladder.png, strata.csv and strata.png."""

    def run(self, console: Console) -> None:
        """Write the files and print their names."""
        from bench.figures.explain import explain

        for path in explain(self):
            say(console, path)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stability(requests.StabilityRequest):
    """Does the prediction move with the cloud, and does it stay when points are drawn again?"""

    def run(self, console: Console) -> None:
        """Measure, print tables, and name the report."""
        from bench.runs.stability import measure_stability

        for table in stability_tables(measure_stability(self)):
            console.print(table)
        say(console, f"Report: {self.out}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Pictures(requests.PicturesRequest):
    """Figures of a run: clouds in one frame, its template, best to worst, the training curve."""

    def run(self, console: Console) -> None:
        """Draw what the run has, and say what it has not."""
        from bench.figures.run import draw_pictures

        for line in draw_pictures(self):
            say(console, line)


@dataclass(frozen=True, slots=True, kw_only=True)
class Study(requests.StudyRequest):
    """Predict, score, explain, draw and test the stability of runs; one page of all results."""

    def run(self, console: Console) -> None:
        """Do what is missing, naming each file, then write the page anew."""
        from bench.runs.study import study

        page = study(self, lambda line: say(console, line), watched(console, "predict"))
        say(console, f"Page: {page}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference(requests.ReferenceRequest):
    """Predict or score a constant answer, and one that is told the true base pose."""

    def run(self, console: Console) -> None:
        """Write the files and print their names."""
        from bench.analysis.beside import write_references

        for path in write_references(self):
            say(console, path)


@dataclass(frozen=True, slots=True, kw_only=True)
class Run(requests.GridRequest):
    """Run the benchmark: methods x categories x seeds, and the tables of their scores.

    Goes on where it was interrupted or killed. Each command has its log in OUT/jobs; one that fails
    costs what depends on it alone.
    """

    def run(self, console: Console) -> None:
        """Show plan and estimate, do what is left, and name what failed."""
        from bench.grid.run import Grid

        grid = Grid(self)
        plan, chains = grid.plan(lambda line: say(console, line))
        status = grid.status(plan, chains)
        steps = [(one.name, step.name) for one in chains for step in one.steps]
        left = sum(step in status.estimate.left for step in steps)
        say(
            console,
            f"{len(chains)} trainings, {left} of their {len(steps)} steps are left; these take "
            f"{in_words(*status.seconds_left())} with {status.workers} at a time",
        )
        if self.plan_only:
            return
        with shown(console, status):
            for name, ended in grid.go(plan, status):
                console.print(chain_line(name, ended), soft_wrap=True)
        failed = status.failed
        for one in failed:
            say(console, f"failed: {one.chain}: {one.reason}")
        if count := grid.set_aside(plan):
            say(console, f"{count} scores of an earlier plan are in {grid.aside}, in no table")
        for path in grid.tables(plan):
            say(console, path)
        if failed:
            raise RuntimeError(f"run: expected every step to end well, found {len(failed)} that "
                               "failed; the same command tries them again")  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Infer(requests.InferRequest):
    """Parts and joints of the object in somebody's cloud or depth image, with a moving twin."""

    def run(self, console: Console) -> None:
        """Answer each input, a line for each; fail at the end where any failed.

        Raises:
            ValueError: How many failed, or what was wrong with the only one.
        """
        from bench.infer.infer import Done, infer, summary

        single = len(self.inputs) == 1 and not any(path.is_dir() for path in self.inputs)

        def tell(done: Done) -> None:
            if not (single and done.error):
                say(Console(stderr=True) if done.error else console, summary(done))

        done = infer(self, tell)
        failed = [one for one in done if one.error]
        if failed and single:
            raise ValueError(failed[0].error)
        if failed:
            raise ValueError(f"expected {len(done)} answers, found {len(done) - len(failed)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibrate(requests.CalibrateRequest):
    """Learn from labelled clouds how far answers of infer are to be trusted, and which way is up.

    Written beside the checkpoint, where infer finds it.
    """

    def run(self, console: Console) -> None:
        """Ask, fit and write; say how often answers were right, and how true the confidences."""
        from bench.infer.calibrate import calibrate

        found, written = calibrate(self, watched(console, "calibrate"))
        for kind, one in found.reliability.items():
            off = f"confidences off by {100 * one.error:.1f} % on other objects"
            say(console, f"{kind}: {100 * one.base_rate:.0f} % right; {off}")
        for path in written:
            say(console, f"Written: {path}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Demo(requests.DemoRequest):
    """A local page where a file is dropped and what infer makes of it appears."""

    def run(self, console: Console) -> None:
        """Serve until Ctrl-C or SIGTERM, which a service manager sends: both clear up."""
        from bench.infer.server import serve

        signal.signal(signal.SIGTERM, signal.default_int_handler)
        serve(self, lambda line: say(console, line))


@dataclass(frozen=True, slots=True, kw_only=True)
class Release(requests.ReleaseRequest):
    """Make a small checkpoint of a finished run, with its card, for scapo.load and infer."""

    def run(self, console: Console) -> None:
        """Write them, and say how large the model is."""
        from bench.runs.release import release

        for path in release(self):
            say(console, f"{path}: {path.stat().st_size:,} bytes")


VERBS: dict[str, Any] = {
    "train": Train[tuple[()]],
    "predict": Predict,
    "evaluate": Evaluate,
    "tables": Tables,
    "explain": Explain,
    "stability": Stability,
    "pictures": Pictures,
    "study": Study,
    "reference": Reference,
    "run": Run,
    "release": Release,
    "infer": Infer,
    "calibrate": Calibrate,
    "demo": Demo,
}
"""In the order of the help, where `train` stands without its methods."""


def train_verb(preset: str | None) -> Any:  # noqa: ANN401 - a type made at run time
    """`Train` over all methods, their flags defaulting to the preset of that name."""
    from bench.methods import all_methods

    methods = [
        Annotated[entry.kind, tyro.conf.subcommand(name, default=entry.preset(preset))]
        for name, entry in all_methods().items()
    ]
    return Train[Union[tuple(methods)]]  # noqa: UP007 - the tuple is not known to the type checker


def prepare(arguments: Sequence[str]) -> tuple[list[str], str | None]:
    """Words for tyro, and the preset that `--preset` names.

    The preset decides the other flags' defaults, so it is looked up before they are parsed.
    `--supervision` takes its labels with commas as well as with spaces.

    >>> prepare(["train", "scapo", "--preset", "cpu", "--supervision", "segmentation,joint"])
    (['train', 'scapo', '--preset', 'cpu', '--supervision', 'segmentation', 'joint'], 'cpu')
    """
    words: list[str] = []
    for word in arguments:
        flag, _, value = word.partition("=")
        words += [flag, value] if flag in ("--preset", "--supervision") and value else [word]
    pairs = list(zip(["", *words], words, strict=False))
    preset = next((word for before, word in pairs if before == "--preset"), None)
    split = [word.split(",") if before == "--supervision" else [word] for before, word in pairs]
    return [piece for pieces in split for piece in pieces], preset
