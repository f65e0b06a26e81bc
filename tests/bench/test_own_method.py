# SPDX-License-Identifier: MIT
"""The example of docs/bring-your-own-method.md, run as a reader would."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys

import numpy as np
import pytest

from bench import __main__ as program
from bench.scoring.score_files import read_scores
from tests.helpers import made
from tests.helpers.pages import code_blocks


@pytest.mark.parametrize("category", ["laptop", pytest.param("eyeglasses", marks=pytest.mark.slow)])
def test_the_example_runs(repository, tmp_path, category, monkeypatch):
    page = (repository / "docs" / "bring-your-own-method.md").read_text()
    code, commands = code_blocks(page, "python")[0], code_blocks(page, "bash")
    assert 25 <= len(code.splitlines()) <= 40
    assert "scapo" not in re.sub(r"scapo-predictions|\"scapo\"", "", code)
    (tmp_path / "halves.py").write_text(code)
    made.make_data(tmp_path / "DATA" / "clean", category)
    monkeypatch.chdir(tmp_path)
    lines = "\n".join(commands).replace("\\\n", " ").splitlines()
    for line in (line.replace("laptop", category) for line in lines if line.strip()):
        name, *arguments = shlex.split(line)
        if name == "python":
            subprocess.run([sys.executable, *arguments], check=True, timeout=60)
        else:
            assert name == "scapo-bench"
            program.main(arguments)
    (scores,) = read_scores(tmp_path / "results" / "scores" / f"{category}-halves.csv.gz")
    assert scores.run.method == "halves"
    for (metric, _), values in scores.errors.items():
        assert np.isfinite(values).all() == (metric != "joint_state")
    assert (tmp_path / "results" / "tables" / "table1.tex").is_file()
    assert (tmp_path / "results" / "explain" / category / "ladder.png").stat().st_size > 1000
