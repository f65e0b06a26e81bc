# SPDX-License-Identifier: MIT
"""The object's frame of a finished training, fitted on training clouds that have labels.

After the last step and for answers alone: no weight changes. A method that learned poses from
labels has the frame already.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from bench.methods import load
from bench.scoring.frame import LEAST_SAMPLES, fit_alignment
from bench.scoring.truth import truth_of
from scapo.alignment import Alignment, LabelledClouds
from scapo.method import AbstractMethod, Mode, evenly
from scapo.records import cat, map_tensors, take
from scapo.store import Split
from scapo.store.checkpoint import WEIGHTS, with_alignment
from scapo.store.samples import SampleDataset, observe, observed
from scapo.types import Prediction

CLOUDS = 300
"""Of the training split, evenly spread, that are asked about."""
MODE: Mode = "quick"
"""The cheapest in which a method that knows modes is good; its frames are the same in all."""
BATCH = 32


def align(run: Path, split: Split, device: str, say: Callable[[str], None]) -> None:
    """Fit and store the alignment of a finished run that has none, or say why it has none.

    Args:
        run: Folder.
        split: That it was trained on.
        device: Where the method runs.
        say: Told what was found.

    Raises:
        StoreError: A checkpoint or data that are damaged.
    """
    method, header = load(run)
    if "pose" in method.supervision or header.get("alignment") is not None:
        return
    found = aligned(method.to(device), split, CLOUDS, MODE, device)
    if found is None:
        say(
            f"poses stay in the method's own frames: {split.folder} has fewer than "
            f"{LEAST_SAMPLES} labelled clouds with an answer"
        )
        return
    with_alignment(run / WEIGHTS, found)
    say(
        f"poses in the object's frame: fitted on {found.clouds.samples} labelled clouds of "
        f"{found.clouds.split}, after training"
    )


def aligned(
    method: AbstractMethod, split: Split, limit: int | None, mode: Mode, device: str
) -> Alignment | None:
    """The alignment of a method by labelled clouds evenly spread over a split.

    Returns:
        None where too few are labelled or answered, or the method gives no poses.
    """
    samples = SampleDataset(split, observed(split))
    batch = samples.batch(evenly(len(samples), limit))
    spread = (batch["points"] - batch["points"][:, :1]).abs().amax((1, 2)) > 0
    index = torch.nonzero((batch["part"] >= 0).any(1) & spread)[:, 0]
    if len(index) < LEAST_SAMPLES:
        return None
    labelled = take(batch, index)
    found = cat([
        answered(method, take(labelled, rows), mode, device)
        for rows in torch.arange(len(index)).split(BATCH)
    ])  # fmt: skip
    truth = truth_of(split.folder, 0, {name: value.numpy() for name, value in labelled.items()})
    clouds = LabelledClouds(
        split=split.manifest.split, data_digest=split.manifest.digest, samples=len(index), mode=mode
    )
    return fit_alignment(found, truth, clouds, method.category)


@torch.no_grad()
def answered(
    method: AbstractMethod, batch: dict[str, Tensor], mode: Mode, device: str
) -> Prediction:
    """What a method on the device says of some samples, on the host; it sees no label."""
    found = method.predict(map_tensors(observe(batch), lambda tensor: tensor.to(device)), mode)
    return map_tensors(found, lambda tensor: tensor.cpu())
