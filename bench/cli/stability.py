# SPDX-License-Identifier: MIT
"""`scapo-bench stability RUN`: equivariance and resampling of a trained method, as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float, Int
from rich.console import Console
from rich.table import Table

from bench.analysis.stability import SHIFT, Plan, Timed, equivariance, resampled, summary
from bench.methods import load
from bench.runs.predict import to_arrays
from bench.runs.train import pick_device
from bench.scoring.scores import Rows
from bench.scoring.truth import revolute
from scapo.method import AbstractMethod, Mode, evenly
from scapo.store import Split, open_split, write_bytes
from scapo.store.files import Header
from scapo.store.provenance import commit, machine
from scapo.store.samples import SampleDataset
from scapo.types import Observation

FORMAT = "scapo-stability/1"
TITLES = {"none": "not moved", "rotation": "turned", "translation": "shifted", "both": "both"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Stability:
    """Does the prediction move with the cloud, and does it stay when points are drawn again?"""

    checkpoint: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, or a checkpoint file."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""
    out: Path
    """Report, FILE.json."""
    split: str = "test"
    """Split whose clouds are used, without labels."""
    mode: Literal["fast", "refine", "both"] = "both"
    """Inference modes to measure."""
    samples: int = 20
    """Clouds, evenly spread over the split."""
    motions: int = 2
    """Random motions of each kind for each cloud."""
    resamplings: int = 20
    """Random subsets of each cloud; 0 for none."""
    points: int | None = None
    """Points of a subset; by default half of the clouds' own, at most 1,024. Data generated with
    --points 4096 have new points to draw, where halves of 1,024 share theirs."""
    seed: int = 0
    """Of motions and subsets."""
    device: str = "auto"
    """auto (CUDA where there is a GPU), cpu, cuda, ..."""
    batch: int = 32
    """Clouds at a time."""

    def run(self, console: Console) -> None:
        """Measure, print a table per mode, write the report."""
        method, header = load(self.checkpoint)
        device = pick_device(self.device)
        method.to(device)
        split = open_split(self.data, header["category"], self.split)
        index = evenly(split.manifest.count, self.samples)
        batch = SampleDataset(split, ("points", "instance")).batch(index)
        points, instance = batch["points"].numpy(), batch["instance"].numpy()
        plan = Plan(
            motions=self.motions,
            resamplings=self.resamplings,
            points=self.points or min(1024, points.shape[1] // 2),
            seed=self.seed,
            batch=self.batch,
        )
        modes: tuple[Mode, ...] = ("fast", "refine") if self.mode == "both" else (self.mode,)
        kinds = revolute(split.manifest)
        measured = {
            mode: measure(Timed(_Answer(method, mode, device)), points, instance, kinds, plan)
            for mode in modes
        }
        report = _report(method, header, split, index, plan) | {
            "modes": measured, "commit": commit(), "machine": machine(device),
        }  # fmt: skip
        text = json.dumps(report, sort_keys=True, indent=1, allow_nan=False)
        write_bytes(self.out, (text + "\n").encode())
        for mode, found in measured.items():
            title = f"{method.name} {header['category']} {self.split}, {mode}, {len(points)} clouds"
            for table in tables(found, f"{title}, {found['clouds_per_second']:.3g} a second"):
                console.print(table)
        console.print(f"Report: {self.out}", soft_wrap=True)


def measure(
    answer: Timed,
    points: Float[np.ndarray, "S N 3"],
    instance: Int[np.ndarray, " S"],
    turns: np.ndarray,
    plan: Plan,
) -> dict[str, Any]:
    """The part of the report on one mode."""
    out: dict[str, Any] = {
        "equivariance": {
            kind: {f"{name}_{unit}": summary(values, instance)
                   for (name, unit), values in found.items()}
            for kind, found in equivariance(answer, points, turns, plan).items()
        },
    }  # fmt: skip
    out["clouds_per_second"] = round(answer.clouds / answer.seconds, 3)
    if plan.resamplings:
        found = resampled(answer, points, plan)
        out["resampling"] = {
            f"{name}_{unit}_{statistic}": {
                **summary(values, instance), "per_sample": _plain(values),
            }
            for (name, unit, statistic), values in found.items()
        }  # fmt: skip
    return out


@dataclass(frozen=True, slots=True)
class _Answer:
    """A method's predictions for clouds and the centres of their cameras."""

    method: AbstractMethod
    mode: Mode
    device: str

    def __call__(self, points: np.ndarray, sensor: np.ndarray) -> Rows:
        observation = Observation(
            points=torch.from_numpy(points).to(self.device),
            sensor=torch.from_numpy(sensor).to(self.device),
        )
        return to_arrays(self.method.predict(observation, self.mode))


def _plain(values: np.ndarray) -> list[list[float | None]]:
    return [[round(v, 6) if v == v else None for v in row] for row in values.tolist()]


def _report(
    method: AbstractMethod, header: Header, split: Split, index: torch.Tensor, plan: Plan
) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "method": method.name,
        "variant": method.variant,
        "category": header["category"],
        "config": header["config"],
        "training": {name: header.get(name) for name in ("seed", "steps", "data_digest")},
        "data": {
            "split": split.manifest.split,
            "digest": split.manifest.digest,
            "points": split.manifest.points,
            "samples": index.tolist(),
        },
        "plan": asdict(plan) | {"translation_m": SHIFT},
    }


def tables(found: dict[str, Any], title: str) -> Iterator[Table]:
    """Changes under motion, a column per kind, and scatter over resamplings."""
    moved = found["equivariance"]
    out = Table("change, median / p95", *(TITLES[kind] for kind in moved), title=title)
    for name in moved["both"]:
        out.add_row(quantity(name), *(_pair(rows[name]) for rows in moved.values()))
    yield out
    if "resampling" not in found:
        return
    rows = found["resampling"]
    out = Table("scatter", "std, median", "MAD, median", "MAD, p95", title="resampled")
    for name in dict.fromkeys(key.rsplit("_", 1)[0] for key in rows):
        std, mad = rows[f"{name}_std"], rows[f"{name}_mad"]
        out.add_row(quantity(name), _ranged(std, "median"), _ranged(mad, "median"),
                    _ranged(mad, "p95"))  # fmt: skip
    yield out


def quantity(name: str) -> str:
    """`base_rotation_deg` as a reader takes it: base rotation, deg."""
    head, unit = name.replace("_", " ").rsplit(" ", 1)
    return head if unit == "1" else f"{head}, {unit}"


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
