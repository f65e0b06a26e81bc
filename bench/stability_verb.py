# SPDX-License-Identifier: MIT
"""`scapo-bench stability RUN`: equivariance and resampling of a trained method, as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float, Int
from rich.console import Console
from rich.table import Table

from bench.methods import load
from bench.predict import to_arrays
from bench.provenance import provenance
from bench.scores import Rows
from bench.stability import SHIFT, Plan, Timed, equivariance, resampled, summary
from bench.train import pick_device
from bench.truth import revolute
from scapo.data import SampleDataset
from scapo.discovery import evenly
from scapo.files import Header
from scapo.method import AbstractMethod, Mode
from scapo.store import Split, open_split, write_bytes
from scapo.types import Observation

FORMAT = "scapo-stability/1"


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
        measured = {
            mode: measure(
                Timed(lambda cloud, mode=mode: _answer(method, cloud, mode, device)),
                points, instance, revolute(split.manifest), plan,
            )
            for mode in modes
        }  # fmt: skip
        report = _report(method, header, split, index, plan) | {
            "modes": measured, **provenance(device),
        }  # fmt: skip
        text = json.dumps(report, sort_keys=True, indent=1, allow_nan=False)
        write_bytes(self.out, (text + "\n").encode())
        for mode, found in measured.items():
            title = f"{method.name} {header['category']} {self.split}, {mode}"
            console.print(table(found, f"{title}, {len(points)} clouds"))
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


def _answer(method: AbstractMethod, points: np.ndarray, mode: Mode, device: str) -> Rows:
    observation = Observation(points=torch.from_numpy(points).to(device))
    return to_arrays(method.predict(observation, mode))


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


def table(found: dict[str, Any], title: str) -> Table:
    """A row per quantity: median and 95th percentile with their intervals."""
    out = Table("", "quantity", "median", "95 % interval", "p95", "95 % interval",
                title=f"{title}, {found['clouds_per_second']:.3g} clouds/s")  # fmt: skip
    groups = {f"moved: {kind}": rows for kind, rows in found["equivariance"].items()}
    groups |= {"resampled": found["resampling"]} if "resampling" in found else {}
    for group, rows in groups.items():
        for number, (name, row) in enumerate(rows.items()):
            cells = [text for key in ("median", "p95") for text in _cells(row.get(key))]
            out.add_row("" if number else group, quantity(name), *cells)
        out.add_section()
    return out


def quantity(name: str) -> str:
    """`axis_deg_std` as a reader takes it: axis, deg, std."""
    words = name.split("_")
    tail = 2 if words[-1] in ("std", "mad") else 1
    head, rest = " ".join(words[:-tail]), [word for word in words[-tail:] if word != "1"]
    return ", ".join([head, *rest])


def _cells(row: dict[str, float] | None) -> tuple[str, str]:
    if row is None:
        return "–", "–"
    return f"{row['value']:.3g}", f"{row['low']:.3g} to {row['high']:.3g}"
