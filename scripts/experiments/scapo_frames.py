# SPDX-License-Identifier: MIT
"""What the encoder of SCAPO needs to learn the frames of a category, told the true ones.

The first stage of preset `warm` with its encoder alone, on 1,500 clouds of `train`: frames of 300
clouds of `val` every 250 steps. Labels enter the fit: a diagnosis, no method.

    python scripts/experiments/scapo_frames.py DATA/complete oven 500 neighbours=40 centres=48

Beside what `EncoderConfig` has: points=N of a cloud, batch=N, lr=RATE.
"""

from __future__ import annotations

import ast
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scapo import store
from scapo.first_weights import initialise
from scapo.geometry.points import normalise
from scapo.geometry.rigid import apply, rigid, rotation_angle
from scapo.paper import losses
from scapo.paper.augment import random_pose
from scapo.paper.autoencoder import Encoder
from scapo.paper.config import warm_config
from scapo.paper.heads import thin
from scapo.store.samples import read_training_data

CLOUDS, UNSEEN, EVERY = 1500, 300, 250


def placed(data: Path, category: str, split: str, count: int) -> tuple[Tensor, Tensor]:
    """Normalised clouds and the true poses of their bases there."""
    known = read_training_data(store.open_split(data, category, split))
    some = torch.arange(count) * len(known.observation.points) // count
    clouds, similarity = normalise(known.observation.points[some])
    if known.labels.camera_T_part is None:
        raise ValueError(f"{data}: expected poses, found none")
    pose = known.labels.camera_T_part[some, 0]
    at = similarity.forward(pose[:, None, :3, 3])[:, 0]
    return clouds, rigid(pose[:, :3, :3], at)


def value(text: str) -> object:
    """A number, several of them, or a word."""
    try:
        return ast.literal_eval(text)
    except ValueError:
        return text


def main(data: Path, category: str, steps: int, sizes: dict[str, Any]) -> None:
    """Train, and print the errors of frames that were not seen."""
    preset, generator = warm_config(), torch.Generator().manual_seed(1)
    batch, rate = sizes.pop("batch", preset.batch), sizes.pop("lr", preset.lr[0])
    count = sizes.pop("points", preset.points)
    network = Encoder(replace(preset.encoder, **sizes))
    initialise(network, generator)
    clouds, pose = placed(data, category, "train", CLOUDS)
    unseen, true = placed(data, category, "val", UNSEEN)
    optimiser = torch.optim.Adam(network.parameters(), rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, preset.min_lr)
    began, terms = time.monotonic(), list[float]()
    for step in range(1, steps + 1):
        drawn = torch.randint(CLOUDS, (batch,), generator=generator)
        some = torch.randperm(clouds.shape[1], generator=generator)[:count]
        move = random_pose(batch, preset.loss.shift, generator, clouds)
        said, wanted = network(apply(move, clouds[drawn][:, some])), move @ pose[drawn]
        frame = losses.pose_agreement(
            said.rotation, said.translation, wanted[:, :3, :3], wanted[:, :3, 3]
        )
        optimiser.zero_grad()
        (frame + preset.loss.ortho * losses.orthonormality(said.frame)).backward()
        optimiser.step()
        schedule.step()
        terms.append(float(frame.detach()))
        if step % EVERY:
            continue
        network.eval()
        with torch.no_grad():
            found = [network(thin(part, count)).rotation for part in unseen.split(50)]
        network.train()
        off = rotation_angle(torch.cat(found), true[:, :3, :3]) * (180 / math.pi)
        near, far = (off < 30).float().mean(), (off > 90).float().mean()
        print(
            f"step {step}, {time.monotonic() - began:.0f} s, term {sum(terms[-50:]) / 50:.3f}; "
            f"degrees of unseen clouds: median {off.median():.1f}, mean {off.mean():.1f}, "
            f"within 30: {near:.0%}, beyond 90: {far:.0%}",
            flush=True,
        )


if __name__ == "__main__":
    main(
        Path(sys.argv[1]),
        sys.argv[2],
        int(sys.argv[3]),
        {name: value(text) for name, text in (word.split("=") for word in sys.argv[4:])},
    )
