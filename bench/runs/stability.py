# SPDX-License-Identifier: MIT
"""`stability`: equivariance and resampling of a trained method, as a JSON report."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from bench.analysis.stability import SHIFT, Plan, Timed, equivariance, resampled, summary
from bench.methods import load
from bench.requests import StabilityRequest
from bench.runs.train import pick_device
from bench.scoring.scores import Rows, to_arrays
from bench.scoring.truth import revolute
from scapo.method import AbstractMethod, Mode, evenly
from scapo.store import Split, open_split, write_bytes
from scapo.store.files import Header, require_suffix
from scapo.store.json_records import readable_json
from scapo.store.provenance import commit, machine
from scapo.store.samples import SampleDataset, observed
from scapo.types import Observation

FORMAT = "scapo-stability/1"


def measure_stability(request: StabilityRequest) -> dict[str, Any]:
    """Measure a method in each mode and write the report; returns it.

    Raises:
        StoreError: No checkpoint, no such data, or a file of another suffix to write.
        ValueError: Subsets that are no smaller than the clouds.
    """
    require_suffix(request.out, ".json")
    method, header = load(request.checkpoint)
    device = pick_device(request.device)
    method.to(device)
    split = open_split(request.data, header["category"], request.split)
    index = evenly(split.manifest.count, request.samples)
    batch = SampleDataset(split, observed(split)).batch(index)
    points, instance = batch["points"].numpy(), batch["instance"].numpy()
    if "sensor" in batch:  # clouds are turned about their cameras, which are put at the origin
        points = points - batch["sensor"].numpy()[:, None]
    plan = Plan(
        motions=request.motions,
        resamplings=request.resamplings,
        points=request.points or min(1024, points.shape[1] // 2),
        seed=request.seed,
        batch=request.batch,
    )
    modes: tuple[Mode, ...] = ("fast", "refine") if request.mode == "both" else (request.mode,)
    kinds = revolute(split.manifest)
    measured = {
        mode: measure(Timed(_Answer(method, mode, device)), points, instance, kinds, plan)
        for mode in modes
    }
    report = _about(method, header, split, index, plan) | {
        "modes": measured, "commit": commit(), "machine": machine(device),
    }  # fmt: skip
    write_bytes(request.out, readable_json(report).encode())
    return report


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


def _about(
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
