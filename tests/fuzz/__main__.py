# SPDX-License-Identifier: MIT
"""`python -m tests.fuzz --seconds 3600`: damaged files of every format, counted.

A case that kills or hangs its process is found too, since each format is played in a worker.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from typing import Any

from scapo.parallel.pool import Pool
from tests.fuzz.formats import FORMATS
from tests.fuzz.play import BATCH, play_batch

COLUMNS = ("read", "refused", "traceback", "hang", "memory", "wrongly read", "died")
TIMEOUT = 300.0
"""Seconds of a machine that is busy; a hang is told by the processor's time."""


def main() -> int:
    """Play for so many seconds; 1 if anything was found."""
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", nargs="*", default=list(FORMATS), choices=list(FORMATS))
    options = parser.parse_args()
    counts = {name: Counter[str]() for name in options.only}
    until, first, bad = time.monotonic() + options.seconds, options.first, []
    with (
        tempfile.TemporaryDirectory() as place,
        Pool[Any, Any](options.workers, timeout=TIMEOUT) as pool,
    ):
        while time.monotonic() < until:
            for outcome in pool.run(play_batch, [(name, place, first) for name in options.only]):
                name = outcome.job[0]
                if outcome.result is None:
                    counts[name]["died"] += 1
                    bad.append(f"{outcome.label}: {outcome.failure}: {outcome.reason}")
                    print(bad[-1], flush=True)  # noqa: T201 - a long run may be broken off
                    continue
                for number, (verdict, words) in outcome.result.items():
                    counts[name][verdict] += 1
                    if verdict not in ("read", "refused"):
                        bad.append(f"{name} {number}: {verdict}: {words}")
                        print(bad[-1], flush=True)  # noqa: T201
            first += BATCH
    print(f"{'format':18}{'tried':>8}" + "".join(f"{column:>14}" for column in COLUMNS))  # noqa: T201
    for name, count in counts.items():
        row = "".join(f"{count[column]:14}" for column in COLUMNS)
        print(f"{name:18}{count.total():8}{row}")  # noqa: T201
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
