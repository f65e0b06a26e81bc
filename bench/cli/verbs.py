# SPDX-License-Identifier: MIT
"""The verbs of `scapo-bench`: one dataclass each, whose fields are the flags."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from bench.analysis.explain import explain
from bench.analysis.reference import Kind, write_reference
from bench.cli.pictures import Pictures
from bench.cli.stability import Stability
from bench.cli.study import Study
from bench.metrics import ApRule
from bench.scoring.evaluate import Request, evaluate
from bench.scoring.score_files import side_file
from bench.scoring.scores import Settings
from bench.tables.paper import check
from bench.tables.results import load
from bench.tables.write import write


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluate:
    """Score a predictions file, written by any program, against the data it was made on."""

    predictions: Path
    """Predictions (safetensors, docs/bring-your-own-method.md)."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""
    out: Path
    """Scores per sample, NAME.csv.gz; the report NAME.json is written beside it."""
    split: str = "test"
    """Split that was predicted."""
    calibration: Path | None = None
    """Predictions of the same run on the training split, to fit the frames of a method that saw
    no poses. Without it poses are compared as given."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)

    def run(self, console: Console) -> None:
        """Score and print the means."""
        report = evaluate(
            Request(
                predictions=self.predictions,
                data=self.data,
                out=self.out,
                split=self.split,
                calibration=self.calibration,
                settings=self.settings,
            )
        )
        if self.calibration is None and "pose" not in report["supervision"]:
            console.print("No --calibration: part poses are compared as given.")
        table = Table(
            title=f"{report['method']} {report['category']} {report['split']}, "
            f"{report['counts']['samples']} samples"
        )
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
        console.print(table)
        console.print(f"Scores: {self.out}\nReport: {side_file(self.out)}", soft_wrap=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Tables:
    """Tables 1, 2 and 3 from scores per sample, the paper's printed numbers beside ours."""

    scores: Path = Path("results/scores")
    """Folder with NAME.csv.gz files, searched through; only the split `test` is used."""
    out: Path = Path("results/tables")
    """Folder for table{1,2,3,4}.{md,csv,tex} and significance.csv. Table 4, ours alone, has the
    mean errors on sensor data and on further categories."""
    ap_rule: ApRule = "mean"
    """How the parts of a sample join in the average precision of Table 2."""
    check_paper: bool = False
    """Only list what does not add up in the paper's printed tables; writes nothing."""

    def run(self, console: Console) -> None:
        """Write the tables, or check the printed ones."""
        lines = check() if self.check_paper else [
            str(path) for path in write(load(self.scores), self.out, self.ap_rule)
        ]  # fmt: skip
        console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Explain:
    """Why a method fails: errors by what was seen, and with one piece replaced by the truth."""

    predictions: Path
    """Predictions (safetensors)."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""
    out: Path
    """Folder for ladder.md, ladder.csv, ladder.png, strata.csv and strata.png."""
    split: str = "test"
    """Split that was predicted."""
    calibration: Path | None = None
    """Predictions of the same run on the training split, as for evaluate."""

    def run(self, console: Console) -> None:
        """Write the files and print their names."""
        request = Request(predictions=self.predictions, data=self.data, out=self.out,
                          split=self.split, calibration=self.calibration)  # fmt: skip
        for path in explain(request):
            console.print(str(path), markup=False, highlight=False, soft_wrap=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """Write the predictions of a constant answer, or of one that is told the true base pose."""

    kind: tyro.conf.Positional[Kind]
    """Which of the two."""
    data: Path
    """Data set: the folder above CATEGORY/train and CATEGORY/SPLIT."""
    category: str
    """Category to predict."""
    out: Path
    """Predictions file (safetensors) for evaluate."""
    split: str = "test"
    """Split to predict."""

    def run(self, console: Console) -> None:
        """Write the file."""
        write_reference(self.kind, self.data, self.category, self.out, split=self.split)
        console.print(str(self.out), markup=False, highlight=False, soft_wrap=True)


VERBS: dict[str, type] = {
    "evaluate": Evaluate,
    "tables": Tables,
    "explain": Explain,
    "stability": Stability,
    "pictures": Pictures,
    "study": Study,
    "reference": Reference,
}
"""In the order of the help."""
