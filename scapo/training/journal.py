# SPDX-License-Identifier: MIT
"""The start of a stage that is told of as it goes on, and kept step by step.

A start may take minutes before the first epoch. Each step that is done lies in a file of its own
until the start is over, with the state of the generator after it, so that a training which was
killed goes on after the last one.
"""

from __future__ import annotations

import hashlib
import logging
import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast, final

import torch

from scapo.method import Journal
from scapo.parallel.ahead import Numbered, ahead
from scapo.parallel.pool import Pool
from scapo.records import pack, unpack
from scapo.store.checkpoint import array
from scapo.store.files import Arrays, Header, canonical_json, read, sha256_bytes, write
from scapo.store.json_records import from_json
from scapo.store.schema import StoreError

logger = logging.getLogger(__name__)

T = TypeVar("T")

FORMAT = "scapo-start/1"
GENERATOR = "generator"
"""Name of the array with the generator's state."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepHeader:
    """What the file of a step says of itself."""

    run: dict[str, Any]
    """Method, configuration, seed and data, as in the checkpoint's header."""
    tree: Any
    """Of `records.pack`."""
    after: str
    """Digest of the step before it, of the first one: of the run and the stage."""
    digest: str
    """Of all that the file holds but the seconds."""
    seconds: float = 0.0
    """That the step took."""


@final
class StoredJournal(Journal):
    """A journal in a folder, of one stage of one run; leaving it ends its processes."""

    def __init__(
        self,
        folder: Path,
        run: Header,
        stage: str,
        tell: Callable[[str, float, float], None],
        workers: int = 0,
    ) -> None:
        """Begin, or take up what is there.

        Args:
            folder: Of the steps' files.
            run: What a run and its continuation agree in.
            stage: Its name.
            tell: Hears what begins, the share that is done and the seconds left.
            workers: Processes for what can be done side by side; with fewer than two, this one.
        """
        self.pool = Pool[Numbered, bytes](workers, timeout=math.inf)
        self.folder, self.run, self._tell = folder, run, tell
        self.after = sha256_bytes(canonical_json([run, stage]).encode())
        self.earlier = 0.0
        """Seconds that steps took which were done before."""

    def __enter__(self) -> StoredJournal:
        return self

    def __exit__(self, *exc: object) -> None:
        self.pool.__exit__(*exc)

    def ahead(self, jobs: Sequence[Callable[[], T]]) -> Sequence[Callable[[], T]]:
        """In the worker processes, where there are several of both."""
        return ahead(self.pool, jobs) if min(self.pool.size, len(jobs)) > 1 else jobs

    def tell(self, words: str, done: float, left: float) -> None:
        """Pass it on."""
        self._tell(words, done, left)

    def once(
        self,
        name: str,
        make: Callable[[], T],
        generator: torch.Generator,
        makers: Mapping[str, Callable[..., Any]],
    ) -> T:
        """What the step's file holds, or what `make` returns, which is then written.

        A file that is damaged, or does not follow the steps before it, is told of and made again.
        """
        path = self.folder / f"{re.sub('[^a-z0-9]+', '-', name)}.safetensors"
        if path.is_file():
            try:
                return cast("T", self._taken_up(path, generator, makers))
            except StoreError as error:
                logger.warning("%s; this step is done again", error)
        began = time.monotonic()
        made = make()
        tree, tensors = pack(made, makers)
        arrays = {key: array(value) for key, value in tensors.items()}
        arrays[GENERATOR] = array(generator.get_state())
        header: Header = {"format": FORMAT, "run": self.run, "tree": tree, "after": self.after}
        self.after = header["digest"] = _digest(arrays, header)
        write(path, arrays, {**header, "seconds": time.monotonic() - began})
        return made

    def _taken_up(
        self, path: Path, generator: torch.Generator, makers: Mapping[str, Callable[..., Any]]
    ) -> object:
        arrays, header = read(path, FORMAT)
        known = from_json(StepHeader, header, f"{path}: header")
        if known.after != self.after or known.digest != _digest(arrays, header):
            found = "damaged" if known.after == self.after else "of other steps before it"
            raise StoreError(f"{path}: expected what a step of this start made, found one {found}")
        tensors = {key: torch.from_numpy(value.copy()) for key, value in arrays.items()}
        try:
            made = unpack(known.tree, tensors, makers)
            generator.set_state(tensors[GENERATOR])
        except (LookupError, RuntimeError, TypeError, ValueError) as error:
            words = " ".join(str(error).split())
            raise StoreError(f"{path}: expected a step's records, found {words}") from error
        self.after, self.earlier = known.digest, self.earlier + known.seconds
        return made


def _digest(arrays: Arrays, header: Header) -> str:
    """SHA-256 over the arrays and the header, without the digest itself and the seconds."""
    said = {key: header[key] for key in ("format", "run", "tree", "after")}
    digest = hashlib.sha256(canonical_json(said).encode())
    for name in sorted(arrays):
        value = arrays[name]
        digest.update(canonical_json([name, str(value.dtype), list(value.shape)]).encode())
        digest.update(value.tobytes())
    return digest.hexdigest()
