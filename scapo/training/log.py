# SPDX-License-Identifier: MIT
"""The record of a run: metrics.jsonl, and TensorBoard where it is installed.

The batch on which a training stopped.

Pictures of a training in progress: the same few clouds each time, where they can be drawn.
"""

from __future__ import annotations

import importlib.util
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

import torch
from jaxtyping import Float, Int
from torch import Tensor

from scapo import pictures as draw
from scapo.method import AbstractMethod
from scapo.pictures import PictureData
from scapo.records import take
from scapo.store.checkpoint import array
from scapo.store.files import canonical_json, write, write_bytes
from scapo.store.json_records import parse_json
from scapo.types import Observation

PICTURES = "pictures"
"""Folder of the pictures of a run."""


def alone(values: Tensor) -> Tensor:
    """The sum over one rank."""
    return values


class Log:
    """Means over a few steps, one JSON line each; the same run writes the same bytes."""

    def __init__(
        self, folder: Path | None, step: int, total: Callable[[Tensor], Tensor] = alone
    ) -> None:
        """Open the log of a run that has done `step` steps; later lines are dropped.

        Args:
            folder: Of the run; None: nothing is written, as on all ranks but the first.
            step: Steps done.
            total: Sums what the ranks have collected.
        """
        self.folder, self.total = folder, total
        self.file = None if folder is None else _continued(folder / "metrics.jsonl", step)
        self.hook, threading.excepthook = threading.excepthook, self._of_thread
        try:
            self.board = None if folder is None else _board(folder / "tensorboard", step)
        except BaseException:
            threading.excepthook = self.hook
            raise
        self.sums: dict[str, Tensor] = {}
        self.count = 0
        self.rate = 0.0
        self.latest: float | None = None

    def collect(self, values: dict[str, Tensor], rate: float) -> None:
        """Add one step's scalars and learning rate; nothing is copied from the device yet."""
        for name, value in values.items():
            held = value.detach()
            self.sums[name] = self.sums[name] + held if name in self.sums else held
        self.count += 1
        self.rate = rate

    def write(self, step: int, stage: str) -> None:
        """A line of the means since the last one."""
        if not self.count:
            return
        means = torch.stack([value.double() for value in self.sums.values()]) / self.count
        means = self.total(means)
        row = dict(zip(self.sums, means.tolist(), strict=True))
        self.latest = row["loss"]
        self._append({"step": step, "stage": stage, "lr": self.rate, **row})
        for name, value in row.items():
            self.scalar(f"{stage}/{name}", value, step)
        self.sums, self.count = {}, 0

    def validation(self, step: int, stage: str, loss: float) -> None:
        """A line of a validation pass; null where the loss is no number that JSON has."""
        said = loss if math.isfinite(loss) else None
        self._append({"step": step, "stage": stage, "validation": said})
        self.scalar(f"{stage}/validation", loss, step)

    def _append(self, record: dict[str, Any]) -> None:
        if self.file is not None:
            with _named(self.file.name):
                self.file.write(canonical_json(record) + "\n")
                self.file.flush()

    def scalar(self, name: str, value: float, step: int) -> None:
        """A number for TensorBoard alone."""
        if self.board is not None:
            with _named(self.folder):
                self.board.add_scalar(name, value, step)

    def picture(self, name: str, picture: PictureData, step: int) -> None:
        """A PNG in pictures/, replacing the one of that name, and an image for TensorBoard."""
        if self.folder is None:
            return
        png, pixels = draw.render(picture)
        write_bytes(self.folder / PICTURES / f"{name}.png", png)
        if self.board is not None:
            with _named(self.folder):
                self.board.add_image(name, pixels, step, dataformats="HWC")

    def _of_thread(self, what: threading.ExceptHookArgs) -> None:
        """TensorBoard's writer is a thread: it meets a full disk first, the next call tells it."""
        if not issubclass(what.exc_type, OSError):
            self.hook(what)

    def close(self) -> None:
        """Close both."""
        if self.file is not None:
            with suppress(OSError):  # every line was flushed: what remains was said not to fit
                self.file.close()
        if self.board is not None:
            with suppress(OSError):
                self.board.close()
        threading.excepthook = self.hook


@contextmanager
def _named(path: object) -> Iterator[None]:
    """A full disk is told with the name of what did not fit."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _continued(path: Path, step: int) -> TextIO:
    """The file, open for more, without lines after that step and those that a kill cut off."""
    lines = path.read_bytes().splitlines() if path.is_file() else []
    kept = [line for line in lines if _step_of(line) <= step]
    write_bytes(path, b"".join(line + b"\n" for line in kept))
    return path.open("a")


def _step_of(line: bytes) -> float:
    """The step of a line; infinite for one that is none of ours."""
    try:
        step = parse_json(line)["step"]
    except (ValueError, RecursionError, TypeError, KeyError):
        return float("inf")
    return step if isinstance(step, int) else float("inf")


def _board(folder: Path, step: int) -> Any:  # noqa: ANN401 - None, or a writer of an extra
    if importlib.util.find_spec("tensorboard") is None:
        return None
    from torch.utils.tensorboard import SummaryWriter

    with _named(folder):
        return SummaryWriter(str(folder), purge_step=step or None)


BAD_BATCH = "bad-batch.safetensors"


def save_batch(
    path: Path,
    stage: str,
    points: Float[Tensor, "B N 3"],
    index: Int[Tensor, " B"],
    terms: dict[str, Tensor],
) -> str:
    """Write clouds, their indices in the split and the terms of the loss; what is wrong."""
    values = {name: str(float(value.detach())) for name, value in terms.items()}
    header = {"format": "scapo-bad-batch/1", "stage": stage, "terms": values}
    write(path, {"points": array(points), "index": array(index)}, header)
    bad = [name for name, value in values.items() if not math.isfinite(float(value))]
    if bad:
        return ", ".join(bad)
    return "finite terms with a bad gradient" if values else "a matrix without decomposition"


SHOWN = 6
"""Training clouds that are shown, evenly taken from the data."""


def can_draw() -> bool:
    """Whether matplotlib and pillow are installed."""
    return all(importlib.util.find_spec(name) is not None for name in ("matplotlib", "PIL"))


def shown(observation: Observation, count: int = SHOWN) -> Observation:
    """The clouds that pictures show."""
    number = observation.points.shape[0]
    count = min(count, number)
    index = torch.arange(count, device=observation.points.device) * number // count
    return take(observation, index)


@torch.no_grad()
def draw_progress(
    method: AbstractMethod, observation: Observation, stage: str, log: Log, step: int
) -> None:
    """Hand the method's pictures to the log, named `STAGE-NAME`; nothing where none are drawn."""
    if not can_draw():
        return
    was_training = method.training
    method.eval()
    for name, picture in method.pictures(shown(observation), stage).items():
        log.picture(f"{stage}-{name}", picture, step)
    method.train(was_training)
