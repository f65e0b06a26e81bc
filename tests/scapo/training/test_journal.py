# SPDX-License-Identifier: MIT
"""A start of many steps that is interrupted goes on after the last one, to the same tensors."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from scapo.records import map_tensors
from scapo.store.files import read, write
from scapo.store.schema import StoreError
from scapo.training import fit
from scapo.training.run_folder import START, kept
from scapo.types import Labels, Observation
from tests.helpers.tiny import tiny_data
from tests.helpers.two_ranks import CONFIG, Line, StoppedError
from tests.scapo.training.test_fit import same

STEPS = 4


class Slow(Line):
    """A start of four steps, each of which draws and adds to what the one before made."""

    def __init__(self, stop: int = STEPS) -> None:
        super().__init__()
        self.stop, self.done = stop, list[str]()

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        del labels
        made = Observation(points=observation.points[0, :5])
        for step in range(STEPS):
            self.journal.tell(f"step {step}", step / STEPS, STEPS - step)
            made = self.journal.once(
                f"Step {step}, of {stage}",
                lambda: self._made(made, stage, generator),  # noqa: B023 - called at once
                generator,
                {"Observation": Observation},
            )
        self.drawn = made.points.mean(-1)

    def _made(self, before: Observation, stage: str, generator: torch.Generator) -> Observation:
        if len(self.done) == self.stop:
            raise StoppedError
        self.done.append(stage)
        return map_tensors(before, lambda x: x + torch.rand(x.shape, generator=generator))


def run(method: Slow, folder: Path, *, resume: bool = False) -> None:
    fit.fit(method, tiny_data(), folder, CONFIG, resume=resume)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    run(Slow(2 * STEPS), folder)
    return folder


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """A run that was killed after three steps of its first start."""
    with pytest.raises(StoppedError):
        run(Slow(3), tmp_path)
    return tmp_path


def files(folder: Path) -> list[Path]:
    return sorted((folder / START).iterdir())


@pytest.mark.parametrize(("stop", "left"), [(1, 7), (3, 5), (6, 2)])
def test_an_interrupted_start_goes_on_bit_for_bit(
    whole: Path, tmp_path: Path, stop: int, left: int
) -> None:
    with pytest.raises(StoppedError):
        run(Slow(stop), tmp_path)
    assert len(files(tmp_path)) == stop % STEPS
    method = Slow(8)
    run(method, tmp_path, resume=True)
    assert len(method.done) == left
    same(whole, tmp_path)
    assert not (tmp_path / START).exists()


def test_a_start_without_a_journal_makes_the_same(whole: Path) -> None:
    method, data = Slow(8), tiny_data()
    noise = torch.Generator().manual_seed(CONFIG.seed)
    method.start("one", data.observation, data.labels, noise)
    method.start("two", data.observation, data.labels, noise)
    stored, _ = read(whole / "checkpoint.safetensors")
    assert np.array_equal(stored["drawn"], method.drawn.numpy())


def damaged(path: Path) -> None:
    """One bit of the last tensor's last number."""
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-5])


def other_draw(path: Path) -> None:
    """Another generator's state, and its digest left as it was."""
    arrays, header = read(path)
    arrays["generator"] = torch.Generator().manual_seed(9).get_state().numpy()
    write(path, arrays, header)


def moved(path: Path) -> None:
    """The step after it, under its name."""
    (path.parent / path.name.replace("-1-", "-2-")).rename(path)


def other_field(name: str, value: Any) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        arrays, header = read(path)
        write(path, arrays, {**header, name: value})

    return change


@pytest.mark.parametrize(
    ("spoil", "again", "said"),
    [
        (damaged, 1, "found one damaged"),
        (cut_off, 1, "expected a safetensors file"),
        (other_draw, 1, "found one damaged"),
        (moved, 2, "found one of other steps before it"),
        (other_field("tree", {"record": "Observation", "fields": {}}), 1, "found one damaged"),
        (other_field("after", "0" * 64), 1, "of other steps before it"),
        (other_field("digest", 3), 1, "digest"),
        (other_field("format", "scapo-samples/1"), 1, "expected format 'scapo-start/1'"),
    ],
)
def test_a_step_that_is_not_as_it_was_written_is_done_again(
    whole: Path,
    cut: Path,
    spoil: Callable[[Path], None],
    again: int,
    said: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    spoil(files(cut)[1])
    method = Slow(8)
    run(method, cut, resume=True)
    assert len(method.done) == 5 + again
    assert said in caplog.text
    assert caplog.text.count("; this step is done again") == 1
    same(whole, cut)


def test_an_earlier_start_is_taken_up_by_its_own_run_alone(cut: Path) -> None:
    assert kept(cut) == "saved 3 steps of its start, resume continues from there"
    with pytest.raises(StoreError, match="expected no run there, found one; --resume continues it"):
        run(Slow(), cut)
    other = replace(CONFIG, seed=2)
    with pytest.raises(StoreError, match="seed: expected 2 to resume, found 1; --resume takes"):
        fit.fit(Slow(8), tiny_data(), cut, other, resume=True)
    assert len(files(cut)) == 3


def test_listeners_hear_of_the_steps_of_a_start(tmp_path: Path) -> None:
    heard: list[tuple[str, str, float, float | None]] = []

    def listener(progress: fit.Progress) -> None:
        heard.append((progress.stage.name, progress.step, progress.done, progress.left))

    fit.fit(Slow(8), tiny_data(), tmp_path, CONFIG, listener=listener)
    steps = [("one", f"step {k}", k / 4, 4 - k) for k in range(4)]
    assert heard[:4] == steps
    assert heard[4][:2] == ("one", "")
    assert heard[4][3] is None


def test_time_of_steps_that_were_done_before_counts(cut: Path) -> None:
    for path in files(cut):
        arrays, header = read(path)
        write(path, arrays, {**header, "seconds": 1000.0})
    run(Slow(8), cut, resume=True)
    spent: dict[str, float] = json.loads((cut / "timing.json").read_text())["stage_seconds"]
    assert 3000 < spent["one"] < 3060


def drawn(seed: int, path: Path) -> Observation:
    """What a step makes that needs no other; a file tells that it was done."""
    path.touch()
    generator = torch.Generator().manual_seed(seed)
    return Observation(points=torch.rand(1, 5, 3, generator=generator))


class Wide(Line):
    """A start of steps that may be done side by side."""

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        del observation, labels
        jobs = [partial(drawn, seed, self.folder / f"{stage}-{seed}") for seed in range(STEPS)]
        total = torch.zeros(1, 5, 3)
        for seed, make in enumerate(self.journal.ahead(jobs)):
            made = self.journal.once(f"seed {seed}", make, generator, {"Observation": Observation})
            total = total + made.points * (1 + seed)
            if seed == self.stop:
                raise StoppedError
        self.drawn = total.mean(-1)[0]

    def __init__(self, folder: Path, stop: int = STEPS) -> None:
        super().__init__()
        self.folder, self.stop = folder, stop
        folder.mkdir(exist_ok=True)


@pytest.mark.slow
def test_steps_side_by_side_are_kept_as_those_one_by_one(tmp_path: Path) -> None:
    """Interrupted after the second of four: two are taken up, whoever made them."""
    here, there = Wide(tmp_path / "a"), Wide(tmp_path / "b", stop=1)
    fit.fit(here, tiny_data(), tmp_path / "here", CONFIG)
    several = replace(CONFIG, workers=2)
    with pytest.raises(StoppedError):
        fit.fit(there, tiny_data(), tmp_path / "there", several)
    assert len(list((tmp_path / "there" / START).iterdir())) == 2
    again = Wide(tmp_path / "c")
    fit.fit(again, tiny_data(), tmp_path / "there", several, resume=True)
    first = again.stages()[0].name
    assert sorted(path.name for path in again.folder.glob(f"{first}-*")) == [
        f"{first}-2",
        f"{first}-3",
    ]
    assert torch.equal(here.drawn, again.drawn)
    same(tmp_path / "here", tmp_path / "there")
