# SPDX-License-Identifier: MIT
"""The archives of scores in `results`: what goes in comes out, from a script that users run."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
from pathlib import Path

import pytest

from scapo.store.files import sha256_file

ROOT = Path(__file__).parents[3]
SCRIPT = ROOT / "scripts/archive_scores.py"
TABLE = (
    "method,variant,seed,sample,metric,slot,value,unit\n"
    'icp,"a, b",1,7,iou,0,0.25,1\n'
    "icp,,1,8,joint_state,0,,deg\n"
)


def run(*words: object) -> None:
    """The script in a process of its own, as a user has it."""
    subprocess.run([sys.executable, SCRIPT, *map(str, words)], check=True, cwd=ROOT)


def test_scores_are_restored_to_the_byte(tmp_path: Path):
    """Quoted words and empty cells too; a report has the digest of the table beside it."""
    scores = tmp_path / "out/scores/clean/laptop.csv.gz"
    scores.parent.mkdir(parents=True)
    scores.write_bytes(gzip.compress(TABLE.encode()))
    report = scores.with_name("laptop.json")
    report.write_text(json.dumps({"summary": {"n": 2}, "digests": {"scores": "another machine's"}}))
    for name in ("once", "again"):
        run("pack", tmp_path / f"{name}.tar.xz", tmp_path / "out")
    assert (tmp_path / "once.tar.xz").read_bytes() == (tmp_path / "again.tar.xz").read_bytes()

    run("restore", tmp_path / "back", tmp_path / "once.tar.xz")
    back = tmp_path / "back/scores/clean/laptop.csv.gz"
    assert gzip.decompress(back.read_bytes()).decode() == TABLE
    said = json.loads(back.with_name("laptop.json").read_text())
    assert said == {"summary": {"n": 2}, "digests": {"scores": sha256_file(back)}}


@pytest.mark.parametrize(
    "archive", sorted((ROOT / "results").rglob("*.tar.xz")), ids=lambda path: path.name
)
def test_archives_hold_scores_of_samples(archive: Path, tmp_path: Path):
    """Every table begins with the columns of the contract, every report names its table."""
    run("restore", tmp_path, archive)
    tables = sorted(tmp_path.rglob("*.csv.gz"))
    assert len(tables) >= 18
    for table in tables:
        with gzip.open(table, "rt") as lines:
            assert next(lines).startswith("method,variant,seed,data,category,split,sample,metric")
        report = json.loads(
            table.with_name(f"{table.name.removesuffix('.csv.gz')}.json").read_text()
        )
        assert report["digests"]["scores"] == sha256_file(table)
