# SPDX-License-Identifier: MIT
"""One damaged file tried: it is read, or refused in one line; anything else is a finding."""

from __future__ import annotations

import dataclasses
import random
import re
import resource
import shutil
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from scapo.parallel.pool import Report
from scapo.text import one_line
from tests.fuzz.formats import FORMATS, Format

Verdict = Literal["read", "refused", "traceback", "hang", "memory", "wrongly read"]
SECONDS = 30.0
"""Of the processor; more is a hang."""
BYTES = 2 << 30
"""That the process's peak may grow by; it stands higher where other tests ran before."""
BATCH = 25
"""Cases between two starts of a worker's job."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What came of a case."""

    verdict: Verdict
    words: str = ""


class Game:
    """Cases of one format, in a folder of its own."""

    def __init__(self, name: str, folder: Path) -> None:
        """Write the good files, and see that they are read."""
        self.name, self.format, self.folder = name, FORMATS[name], folder
        folder.mkdir(parents=True)
        self.file = self.format.make(folder)
        self.good = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        self.format.read(self.file)

    def damaged(self, number: int) -> bytes:
        """The bytes of a case."""
        rng = random.Random(f"{self.name} {number}")
        return rng.choice(self.format.damage)(rng, self.good[self.file])

    def play(self, number: int) -> Finding:
        """Try a case."""
        return self.attempt(self.damaged(number))

    def attempt(self, data: bytes) -> Finding:
        """Read the file with these bytes."""
        for path, good in self.good.items():
            if not path.exists() or path.read_bytes() != good:
                path.write_bytes(good)
        self.file.write_bytes(data)
        begun, before = time.process_time(), peak()
        finding = judge(self.format, self.file)
        if time.process_time() - begun > SECONDS:
            return Finding(verdict="hang", words=finding.words)
        if peak() - before > BYTES:
            return Finding(verdict="memory", words=finding.words)
        return finding

    def close(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def peak() -> int:
    """The most bytes that this process has held."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def play_batch(job: tuple[str, str, int], report: Report) -> dict[int, tuple[str, str]]:
    """A batch of cases, by number."""
    name, place, first = job
    game = Game(name, Path(place) / f"{name.replace(' ', '-')}-{first}")
    found = {}
    for number in range(first, first + BATCH):
        report(f"{name} {number}", 1)
        finding = game.play(number)
        found[number] = (finding.verdict, finding.words[:300])
    game.close()
    return found


def judge(form: Format, file: Path) -> Finding:
    """Read the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = form.read(file)
    except form.errors as error:
        return Finding(verdict=refusal(str(error), file), words=str(error))
    except Exception as error:  # noqa: BLE001 - this is what is looked for
        return Finding(verdict="traceback", words=f"{type(error).__name__}: {error}")
    verdict: Verdict = "read" if is_sound(result) else "wrongly read"
    return Finding(verdict=verdict, words=f"{result!r:.200}")


def refusal(words: str, file: Path) -> Verdict:
    """Whether an error, printed as the programs print it, names the file; no check of types."""
    line = one_line(words)
    named = any(up.name in line for up in (file, *file.parents[:4]))
    return "refused" if named and not re.search("TypeCheck|eartype", line) else "traceback"


def is_sound(value: object) -> bool:
    """No number in a result is NaN or infinite, but those that may be unknown."""
    if isinstance(value, float):
        return bool(np.isfinite(value))
    if isinstance(value, np.ndarray):
        return value.dtype.kind != "f" or bool(np.isfinite(value).all())
    if isinstance(value, Mapping):
        return all(map(is_sound, value.values()))
    if isinstance(value, list | tuple):
        return all(map(is_sound, value))
    if dataclasses.is_dataclass(value):
        unknown = {"state", "visible", "robot", "surfaces"}
        names = [item.name for item in dataclasses.fields(value) if item.name not in unknown]
        return all(is_sound(getattr(value, name)) for name in names)
    return True
