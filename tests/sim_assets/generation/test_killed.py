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

out, rounds, rng = Path(sys.argv[1]), int(sys.argv[2]), random.Random(sys.argv[3])
options = DataOptions(protocol="full", points=512, count=400, instances=20)
request, assets = make_request("laptop", options)
found = versions(request.settings.backend)
started = time.monotonic()
generate(request, assets, out / "whole", found, Running(workers=0))
seconds = time.monotonic() - started
kills = 0
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


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
def test_killed_at_random_instants_it_ends_with_the_same_bytes(tmp_path: Path, repository: Path):
    """Up to twenty times; it is done earlier when enough was left by those before."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", KILLED, str(tmp_path), "20", "1"],
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
