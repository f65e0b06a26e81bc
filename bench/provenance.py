# SPDX-License-Identifier: MIT
"""Which code on which machine made a result."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

from scapo.checkpoint import versions


def provenance(device: str = "cpu") -> dict[str, Any]:
    """Commit, versions and machine, for the JSON beside a result."""
    return {
        "commit": commit(),
        "versions": versions(),
        "machine": {
            "processor": processor(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "device": torch.cuda.get_device_name(device) if device.startswith("cuda") else device,
        },
    }


def commit(folder: Path = Path(__file__).parent) -> str | None:
    """The commit of the checkout that holds `folder`; None for an installed package.

    `-dirty` is behind it where tracked files differ.
    """
    found = _git(folder, "rev-parse", "HEAD")
    if not found or _git(folder, "ls-files", "--", ".") == "":
        return None
    changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return f"{found}-dirty" if changed else found


def processor() -> str:
    """The processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _git(folder: Path, *words: str) -> str | None:
    command = ["git", "-C", str(folder), *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
