# SPDX-License-Identifier: MIT
"""`scapo-bench predict RUN`: a trained method's answers to a split, as a predictions file."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from jaxtyping import Int
from rich.console import Console
from rich.progress import track

from bench.methods import load
from bench.runs.train import pick_device
from bench.scoring.predictions import Header, write_predictions
from scapo.method import AbstractMethod, Mode, OracleMethod, evenly
from scapo.store import open_split
from scapo.store.files import Arrays
from scapo.store.samples import SampleDataset, label, map_labels, observe
from scapo.training.run_folder import TIMING
from scapo.types import Observation, Prediction

RUN_FIELDS = ("commit", "config", "data_digest", "machine", "seed", "training")
"""Of the checkpoint's header, handed on to scores and tables."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Predict:
    """Predict parts, poses and joints of every cloud of a split."""

    checkpoint: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, or a checkpoint file."""
    data: Path
    """Data set: the folder above CATEGORY/SPLIT, or above that of a benchmark."""
    out: Path
    """Predictions file, NAME.safetensors."""
    split: str = "test"
    """Split to predict."""
    mode: Mode = "fast"
    """fast: networks only; refine: with optimisation at test time."""
    oracle: bool = False
    """Show a method that can use them true labels of the test split (icp: the parts); the
    variant then begins with oracle."""
    device: str = "auto"
    """auto (CUDA where there is a GPU), cpu, cuda, ..."""
    batch: int = 32
    """Clouds at a time."""
    limit: int | None = None
    """Predict so many clouds alone, evenly spread over the split (500 are enough to calibrate);
    the others have no answer in the file."""

    def run(self, console: Console) -> None:
        """Load, predict batch by batch, write the file."""
        method, header = load(self.checkpoint)
        device = pick_device(self.device)
        method.to(device)
        oracle = self._oracle_words(method)
        split = open_split(self.data, header["category"], self.split)
        samples = SampleDataset(split)
        chosen = evenly(len(samples), self.limit or len(samples))
        started = time.perf_counter()
        parts = [
            self._answer(method, samples, index, device)
            for index in track(chosen.split(self.batch), description="predict", console=console)
        ]
        seconds = (time.perf_counter() - started) / len(chosen)
        words = [method.variant, "" if self.mode == "fast" else self.mode, *oracle]
        write_predictions(
            self.out,
            Header(
                method=method.name,
                variant="-".join(word for word in words if word),
                category=header["category"],
                split=self.split,
                seed=header["seed"],
                data_digest=split.manifest.digest,
                supervision=tuple(sorted(method.supervision)),
                budget={
                    "device": device,
                    "parameters": sum(item.numel() for item in method.parameters()),
                    "steps": header["steps"],
                    **timing(self.checkpoint),
                    "seconds_per_cloud": round(seconds, 5),
                },
                run={name: header[name] for name in RUN_FIELDS if name in header},
            ),
            joined(parts, chosen.numpy(), len(samples)),
        )
        console.print(
            f"{len(chosen)} clouds, {1000 * seconds:.1f} ms each: {self.out}", soft_wrap=True
        )

    def _oracle_words(self, method: AbstractMethod) -> list[str]:
        """What the variant says of labels at test time.

        Raises:
            ValueError: The method cannot use any.
        """
        if not self.oracle:
            return []
        if not isinstance(method, OracleMethod):
            raise ValueError(f"--oracle: expected a method that takes one, found {method.name}")
        return [f"oracle-{'-'.join(sorted(method.oracle))}"]

    def _answer(
        self, method: AbstractMethod, samples: SampleDataset, index: torch.Tensor, device: str
    ) -> Arrays:
        """The tensors of a predictions file for the samples of `index`."""
        batch = samples.batch(index)
        observation = Observation(points=observe(batch).points.to(device))
        if self.oracle and isinstance(method, OracleMethod):
            labels = map_labels(label(batch).keep(method.oracle), lambda tensor: tensor.to(device))
            return to_arrays(method.predict_given(observation, labels))
        return to_arrays(method.predict(observation, self.mode))


def joined(parts: Sequence[Arrays], chosen: Int[np.ndarray, " K"], count: int) -> Arrays:
    """The answers of batches one after the other, NaN for the samples that are not `chosen`."""
    out = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if len(chosen) == count:
        return out
    full = {name: np.full((count, *array.shape[1:]), np.nan, array.dtype)
            for name, array in out.items()}  # fmt: skip
    for name, array in full.items():
        array[chosen] = out[name]
    return full


def timing(run: Path) -> dict[str, Any]:
    """Seconds of training, where the run folder is at hand."""
    path = (run if run.is_dir() else run.parent) / TIMING
    if not path.is_file():
        return {}
    return {"training_seconds": round(json.loads(path.read_text())["seconds"], 1)}


def to_arrays(prediction: Prediction) -> Arrays:
    """CONTRACT 3's tensors; what the method does not say is left out."""
    joints = prediction.joints
    tensors = {
        "part_weight": prediction.part_weight,
        "camera_T_part": prediction.camera_T_part,
        "joint_pivot": None if joints is None else joints.pivot,
        "joint_axis": None if joints is None else joints.axis,
        "joint_state": None if joints is None else joints.state,
        "canonical_points": prediction.canonical_points,
        "confidence_sample": prediction.confidence,
        **{f"record_{name}": tensor for name, tensor in (prediction.record or {}).items()},
    }
    return {
        name: tensor.detach().cpu().numpy().astype(np.float32)
        for name, tensor in tensors.items()
        if tensor is not None
    }
