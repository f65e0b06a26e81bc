# SPDX-License-Identifier: MIT
"""The notebook runs top to bottom, and what it says of the hinge is so."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import matplotlib
import pytest

from sim_assets.rendering.backends import resolve_backend
from sim_assets.rendering.base import RenderError


def notebook(repository: Path) -> list[dict[str, Any]]:
    return json.loads((repository / "docs" / "joints.ipynb").read_text())["cells"]


def test_it_is_kept_without_outputs(repository: Path):
    code = [cell for cell in notebook(repository) if cell["cell_type"] == "code"]
    assert len(code) >= 4
    assert [cell["outputs"] for cell in code] == [[]] * len(code)


def test_it_runs_and_finds_the_hinge(repository: Path, capsys: pytest.CaptureFixture[str]):
    try:
        resolve_backend("auto")
    except RenderError as error:
        pytest.skip(str(error))
    matplotlib.use("agg")
    names: dict[str, Any] = {}
    for number, cell in enumerate(notebook(repository)):
        if cell["cell_type"] == "code":
            tree = ast.parse("".join(cell["source"]), f"joints.ipynb, cell {number}")
            exec(compile(tree, f"joints.ipynb, cell {number}", "exec"), names)
    names["plt"].close("all")
    assert "degrees off" in capsys.readouterr().out
    assert names["part"].shape == names["points"].shape[:1]
    assert float(names["degrees"]) < 15
    assert float(names["away"]) < 0.1
