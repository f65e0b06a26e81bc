# SPDX-License-Identifier: MIT
"""A data set whose making is killed again and again has the bytes of one that was left alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

KILLED = """
import os, random, signal, sys, time
from pathlib import Path
from sim_assets.generation.generate import Running, generate
from sim_assets.options import DataOptions
from sim_assets.generation.request import make_request, versions

out, rounds, rng = Path(sys.argv[1]), int(sys.argv[2]), random.Random("1")
points, count, instances = map(int, sys.argv[3:])
options = DataOptions(protocol="full", points=points, count=count, instances=instances)
request, assets = make_request("laptop", options)
found = versions(request.settings.backend)
started = time.monotonic()
generate(request, assets, out / "whole", found, Running(workers=0))
seconds = time.monotonic() - started
kills = renamed = 0
rename = Path.replace


def die_at_the_second_file(path, goal):
    global renamed
    renamed += 1
    if renamed == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return rename(path, goal)


if not rounds:
    Path.replace = die_at_the_second_file
while True:
    child = os.fork()  # what it needs is imported: it begins at once
    if child == 0:
        generate(request, assets, out / "killed", found, Running(workers=0))
        os._exit(0)
    if kills < rounds:
        time.sleep(rng.uniform(0, 0.5) * seconds)
        os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    if status == 0:
        break
    assert os.WTERMSIG(status) == signal.SIGKILL, status
    kills += 1
print(kills)
"""
"""Arguments: a folder; how often it is killed at random, 0: whenever it is about to put a second
file in its place; points, samples and objects."""


@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
@pytest.mark.parametrize(
    "words",
    [
        pytest.param((0, 64, 128, 2), id="at each file"),
        pytest.param((20, 512, 400, 20), id="at random", marks=pytest.mark.slow),
    ],
)
def test_killed_again_and_again_it_ends_with_the_same_bytes(
    words: tuple[int, ...], tmp_path: Path, repository: Path
):
    """At random up to twenty times; it is done earlier when enough was left by those before."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", KILLED, str(tmp_path), *map(str, words)],
        cwd=repository,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 3
    whole, killed = (
        {path.name: path.read_bytes() for path in sorted((tmp_path / name).iterdir())}
        for name in ("whole", "killed")
    )
    assert killed == whole
    assert "manifest.json" in whole
