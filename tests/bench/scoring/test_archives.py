# SPDX-License-Identifier: MIT
"""The archives of scores in `results`: what goes in comes out, from a script that users run."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

from scapo.store.files import sha256_file

ROOT = Path(__file__).parents[3]
SCRIPT = ROOT / "scripts/archive_scores.py"
TABLE = (
    "method,variant,seed,sample,metric,slot,value,unit\n"
    'icp,"a, b",1,7,iou,0,0.291873964,1\n'
    "icp,,1,7,joint_pivot_r4,0,1.25e-06,1\n"
    "icp,,1,8,joint_state,0,,deg\n"
)


def run(*words: object) -> None:
    """The script in a process of its own, as a user has it."""
    subprocess.run([sys.executable, SCRIPT, *map(str, words)], check=True, cwd=ROOT)


def test_scores_are_restored_with_five_digits(tmp_path: Path):
    """Quoted words and empty cells to the byte; a report has the digest of the table beside it."""
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
    assert gzip.decompress(back.read_bytes()).decode() == TABLE.replace("0.291873964", "0.29187")
    said = json.loads(back.with_name("laptop.json").read_text())
    assert said == {"summary": {"n": 2}, "digests": {"scores": sha256_file(back)}}


def test_what_cannot_be_packed_or_restored_is_one_line_and_costs_no_archive(tmp_path: Path):
    archive = tmp_path / "kept.tar.xz"
    archive.write_bytes(b"what was there")
    (tmp_path / "empty").mkdir()
    (tmp_path / "torn/scores").mkdir(parents=True)
    (tmp_path / "torn/scores/a.csv.gz").write_bytes(gzip.compress(b"method,seed\nicp,1\nicp\n"))
    for words in (
        ("pack", archive, tmp_path / "empty"),
        ("pack", archive, tmp_path / "torn"),
        ("restore", tmp_path / "out", archive),
        ("restore", tmp_path / "out", tmp_path / "none.tar.xz"),
    ):
        found = subprocess.run([sys.executable, SCRIPT, *map(str, words)],
                               capture_output=True, text=True, check=False)  # fmt: skip
        assert found.returncode == 1
        assert found.stderr.startswith("archive_scores: ")
        assert found.stderr.count("\n") == 1
    assert archive.read_bytes() == b"what was there"


COLUMNS = [
    "method", "variant", "seed", "data", "category", "split", "sample", "metric",
    "slot", "value", "unit",
]  # fmt: skip


@pytest.mark.parametrize(
    "archive", sorted((ROOT / "results").rglob("*scores*.tar.xz")), ids=lambda path: path.name
)
def test_archives_hold_tables_on_their_sides_and_reports(archive: Path):
    """One line for each column of the contract; read here, since restoring all takes long."""
    with tarfile.open(archive) as packed:
        files = {one.name: file.read() for one in packed if (file := packed.extractfile(one))}
    tables = [name for name in files if name.endswith(".csv")]
    assert len(tables) >= 5
    assert {name.removesuffix(".csv") + ".json" for name in tables} == set(files) - set(tables)
    for name in tables:
        lines = files[name].decode().splitlines()
        assert [line.partition(",")[0] for line in lines] == COLUMNS
        assert len({line.count(",") for line in lines if '"' not in line}) == 1
