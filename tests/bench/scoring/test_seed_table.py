# SPDX-License-Identifier: MIT
"""The table of seeds: reports of several runs in one archive, numbers, and what is read off."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pandas as pd

ROOT = Path(__file__).parents[3]
SCRIPT = ROOT / "scripts/seed_table.py"
METRICS = ("iou_1", "joint_direction_deg", "joint_pivot_r4", "part_rotation_deg",
           "part_translation_r4")  # fmt: skip


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, SCRIPT, *map(str, words)], capture_output=True,
                          text=True, check=False, cwd=ROOT)  # fmt: skip


def report(out: Path, seed: int, mode: str, mean: float) -> None:
    """One of a laptop, all of whose means are the same."""
    path = out / f"scores/clean/laptop-registered-seed{seed}-{mode}-val.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    summary = {name: {"mean": mean, "low": mean - 0.1, "high": mean + 0.1} for name in METRICS}
    budget = {"seconds_per_cloud": 0.25, "training_seconds": 600, "training_gigabytes": 1.04}
    variant = "objects" + ("" if mode == "fast" else f"-{mode}")
    path.write_text(json.dumps({
        "category": "laptop", "seed": seed, "variant": variant, "budget": budget,
        "summary": summary, "run": {"commit": "abc", "machine": {"threads": 2}}
    }))  # fmt: skip
    path.with_name(path.name.replace(".json", ".one-order.json")).write_text("{}")


def test_reports_of_several_runs_make_one_table(tmp_path: Path) -> None:
    archive, out = tmp_path / "reports.tar.xz", tmp_path / "seeds"
    report(tmp_path / "a", 1, "fast", 0.5)
    report(tmp_path / "a", 1, "refine", 0.5)
    assert run("keep", archive, tmp_path / "a").returncode == 0
    report(tmp_path / "b", 2, "refine", 0.8)
    report(tmp_path / "b", 1, "fast", 0.7)  # another answer to what is there
    assert "3 reports" in run("keep", archive, tmp_path / "b").stdout
    assert run("table", archive, out).returncode == 0
    numbers = pd.read_csv(out.with_suffix(".csv")).set_index(["mode", "seed", "what"]).value
    assert numbers["fast", 1, "S"] == 70
    assert numbers["refine", 2, "R"] == 0.8
    text = out.with_suffix(".md").read_text()
    assert "| laptop (clean) | 1 | 70.0 [60.0, 80.0] | 0.7 [0.6, 0.8] | 0.700" in text
    assert "| 4.0 | 10 | 1.04 | 2 | abc |" in text
    assert "| refine | laptop (clean) | 1, 2 | 30.0 | 0.3 | 0.300 | 0.3 | 0.300 |" in text
    assert "| fast | laptop (clean) | 1, 2" not in text


def test_nothing_to_keep_or_print_is_one_line(tmp_path: Path) -> None:
    for words in (("keep", tmp_path / "r.tar.xz", tmp_path), ("table", tmp_path / "r.tar.xz", "t")):
        found = run(*words)
        assert found.returncode == 1
        assert found.stderr.startswith("seed_table: ")
        assert found.stderr.count("\n") == 1
