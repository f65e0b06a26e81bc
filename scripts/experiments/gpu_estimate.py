#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""What training would take on a GPU that is not at hand, by what its steps do (row 415).

    python scripts/experiments/gpu_estimate.py DATA/PART CATEGORY METHOD/PRESET [METHOD/PRESET ...]

A line a stage: a training step is made here on a few clouds; its operators, the bytes that they
read and write and the products that they sum are counted; each operator is given the longest of
its launch, its bytes and its products at an H100's rates. Where a method has no epochs, such as
template registration, its whole training is made and counted (the starts of others are left out).
A roofline: what waits for the host, and what libraries do badly, comes on top of it.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from bench.methods import METHODS
from scapo.categories import CATEGORIES
from scapo.method import AbstractMethod, Stage, Step
from scapo.store import open_split
from scapo.store.samples import TrainingData, read_training_data
from scapo.training.distributed import present
from scapo.training.fit import FitConfig, fit
from scapo.training.optimiser import Descent, make_optimiser, schedule
from scapo.training.precision import Arithmetic, scaler

LAUNCH, SOLVE = 6e-6, 5e-4
"""Seconds of an operator that does next to nothing, and of one that decomposes small matrices."""
BYTES, PRODUCTS = 0.7 * 3.35e12, 0.4 * 67e12
"""A second: 70 % of an H100 SXM's memory rate; 40 % of its single-precision rate, without TF32, a
product and a sum counted as two."""
FEW = 2
"""Clouds of a step that is made here; operators are as many in a larger one."""


class Count(TorchDispatchMode):
    """Adds up the operators of what runs within, but for those that only look otherwise at data."""

    def __init__(self, times: float) -> None:
        """Nothing yet; bytes and products count so many times, for a batch that is larger."""
        super().__init__()
        self.times = times
        self.operators, self.moved, self.products, self.seconds = 0, 0.0, 0.0, 0.0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # noqa: ANN401
        """Run one operator and count it."""
        out = func(*args, **(kwargs or {}))
        name = func._schema.name
        if func.is_view or name == "aten::detach":
            return out
        moved = sum(map(size, tree_leaves((args, kwargs, out)))) * self.times
        counter = flop_registry.get(func.overloadpacket)
        products = counter(*args, **(kwargs or {}), out_val=out) * self.times if counter else 0.0
        least = SOLVE if "linalg" in name or "_svd" in name else LAUNCH
        self.operators += 1
        self.moved, self.products = self.moved + moved, self.products + products
        self.seconds += max(least, moved / BYTES, products / PRODUCTS)
        return out


def size(value: object) -> float:
    """Bytes that are read or written of it, where it is a tensor."""
    if not isinstance(value, torch.Tensor):
        return 0.0
    return min(value.numel() * value.element_size(), value.untyped_storage().nbytes())


def of_step(method: AbstractMethod, stage: Stage, data: TrainingData) -> Count:
    """A step of the stage, in its second half, after one that makes what later ones find."""
    rows = torch.arange(min(FEW, stage.batch))
    seen, labels = data.batch(rows)
    optimiser = make_optimiser(method, stage)
    schedule(stage, optimiser, 0.6)
    descent = Descent(
        method=method, clip=10.0, arithmetic=Arithmetic(), device="cpu", ranks=present(),
        scaler=scaler("float32", "cpu"),
    )  # fmt: skip
    where = Step(stage=stage.name, progress=0.6, generator=torch.Generator().manual_seed(1),
                 index=rows, total=len(data.observation.points))  # fmt: skip
    count = Count(stage.batch / len(rows))
    descent.step(optimiser, lambda: method.losses(seen, labels, where), 1.0)
    with count:
        descent.step(optimiser, lambda: method.losses(seen, labels, where), 1.0)
    return count


def lines(name: str, folder: Path, category: str) -> Iterator[str]:
    """A line for each stage of METHOD/PRESET."""
    method, preset = name.split("/")
    generator = torch.Generator().manual_seed(1)
    entry = METHODS[method]
    built = entry.build(entry.preset(preset), CATEGORIES[category], generator).train()
    data = read_training_data(open_split(folder, category, "train")).keep(built.supervision)
    if entry.rank >= 80:
        with tempfile.TemporaryDirectory() as out, Count(1.0) as count:
            fit(built, data, Path(out) / "run", FitConfig(pictures_every=None))
        yield f"{name}: {count.operators:,} operators, {count.seconds / 60:.1f} min"
        return
    for stage in built.stages():
        found = of_step(built, stage, data)
        steps = stage.epochs * ((stage.clouds or len(data.observation.points)) // stage.batch)
        yield (
            f"{name} {stage.name}: {stage.epochs} epochs of {stage.batch} a step: "
            f"{found.operators:,} operators, {found.moved / 1e9:.1f} GB, "
            f"{found.products / 1e9:,.0f} G operations, {1e3 * found.seconds:.0f} ms; "
            f"{stage.batch / found.seconds:,.0f} clouds/s, {steps * found.seconds / 60:.1f} min"
        )


def main() -> None:
    """Print the lines."""
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    folder, category, *names = sys.argv[1:]
    torch.set_num_threads(1)
    for name in names:
        for line in lines(name, Path(folder), category):
            print(line, flush=True)


if __name__ == "__main__":
    main()
