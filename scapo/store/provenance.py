# SPDX-License-Identifier: MIT
"""Where a result comes from: the state of the code and the machine, without names or paths."""

from __future__ import annotations

import platform
import subprocess
import sys
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from os import cpu_count
from pathlib import Path

import torch

try:
    import resource
except ImportError:  # not on Windows
    resource = None

PACKAGE = Path(__file__).resolve().parent.parent


@lru_cache(maxsize=1)
def commit(package: Path = PACKAGE) -> str:
    """`git describe` of the checkout that holds the package, else `version X` of the installed one.

    Ends in `-dirty` where tracked files differ from the commit.
    """
    top = _git(package, "rev-parse", "--show-toplevel")
    # A package installed somewhere below a checkout of something else is not that something.
    if top is not None and Path(top).resolve() == package.parent:
        described = _git(package, "describe", "--always", "--dirty", "--tags", "--abbrev=12")
        if described is not None:
            return described
    try:
        return f"version {version('scapo')}"
    except PackageNotFoundError:
        return "unknown"


def _git(folder: Path, *words: str) -> str | None:
    """The answer of git, None where there is none."""
    try:
        done = subprocess.run(
            ["git", "--no-optional-locks", *words],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=20,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None


def machine(device: str = "cpu") -> dict[str, str | int]:
    """Processor, cores, threads of this process, system, torch, and the accelerator in use."""
    found: dict[str, str | int] = {
        "cpu": processor(),
        "cores": cpu_count() or 1,
        "threads": torch.get_num_threads(),
        "system": f"{platform.system()} {platform.machine()}",
        "torch": torch.__version__,
        "device": device,
    }
    if device.startswith("cuda"):
        found["gpu"] = torch.cuda.get_device_name(device)
        found["cuda"] = torch.version.cuda or "none"
    return found


def processor(listing: Path = Path("/proc/cpuinfo")) -> str:
    """The processor's name as the system tells it."""
    try:
        lines = listing.read_text().splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next(iter(named), "") or platform.processor() or platform.machine()


def peak_memory() -> int | None:
    """Most bytes that this process had in memory, or one of those that it began and that ended.

    None where the system does not tell.
    """
    if resource is None:
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    own, ended = (
        unit * resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    # Linux counts for a process what the one had that began it; for those that ended it does, too,
    # but that is what this one had.
    with suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        own = 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
    return max(own, ended)
