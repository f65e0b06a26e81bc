# SPDX-License-Identifier: MIT
"""The records in a split's folder: files of its own, each field checked."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from sim_assets.generation.assets import ProceduralAsset
from sim_assets.generation.ledger import FINISHED, PLAN, GenerateError, Ledger
from sim_assets.generation.plan import Entry, instance_record

ASSET = ProceduralAsset(category="laptop", split="train", seed=1, index=0)


def begun(folder: Path) -> dict[str, Any]:
    """A split that was begun; its plan."""
    entry = Entry(asset=ASSET, instance=instance_record(ASSET.load()), geometry="0" * 64)
    with Ledger(folder, {"count": 1}, {"a": "1"}) as ledger:
        ledger.begin([entry], {"other": "why"})
    return json.loads((folder / PLAN).read_text())


def opened(folder: Path) -> Any:
    with Ledger(folder, {"count": 1}, {"a": "1"}) as ledger:
        return ledger.finished(), ledger.entries([ASSET])


def test_what_was_begun_is_read_again(tmp_path: Path):
    begun(tmp_path)
    finished, entries = opened(tmp_path)
    assert finished == {}
    assert entries is not None
    assert [entry.instance for entry in entries[0]] == [instance_record(ASSET.load())]
    assert entries[1] == {"other": "why"}


@pytest.mark.parametrize("name", ["manifest.json", PLAN, FINISHED])
@pytest.mark.parametrize("kind", ["link", "dangling link", "pipe", "folder"])
def test_records_that_are_no_files_of_its_own_are_refused(kind: str, name: str, tmp_path: Path):
    folder, other = tmp_path / "split", tmp_path / "precious"
    begun(folder)
    (folder / name).unlink(missing_ok=True)
    other.write_text("mine")
    if kind == "pipe":
        os.mkfifo(folder / name)
    elif kind == "folder":
        (folder / name).mkdir()
    else:
        (folder / name).symlink_to(other if kind == "link" else "none")
    with pytest.raises(GenerateError, match=f"{name}: expected a file of its own, found a link"):
        opened(folder)
    assert other.read_text() == "mine"


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("entries", None, "entries: expected a list"),
        ("entries", [{}], "expected field 'instance'"),
        ("refused", {"x": 3}, r"refused\['x'\]: expected text"),
        ("versions", ..., "expected field 'versions'"),
        ("identity", [], "identity: expected an object"),
        ("format", "scapo-plan/2", "expected format 'scapo-plan/1'"),
    ],
)
def test_each_field_of_the_plan_is_checked(field: str, value: Any, words: str, tmp_path: Path):
    plan = begun(tmp_path) | {field: value}
    if value is ...:
        del plan[field]
    (tmp_path / PLAN).write_text(json.dumps(plan))
    with pytest.raises(GenerateError, match=words) as caught:
        opened(tmp_path)
    assert PLAN in str(caught.value)


def test_a_plan_of_other_objects_is_refused(tmp_path: Path):
    plan = begun(tmp_path)
    plan["entries"][0]["instance"]["id"] = "x" * 10_000
    (tmp_path / PLAN).write_text(json.dumps(plan))
    with pytest.raises(GenerateError, match="expected the objects it was begun with") as caught:
        opened(tmp_path)
    assert len(str(caught.value)) < 600


def test_a_record_that_a_backup_shares_is_not_written_on(tmp_path: Path):
    folder, backup = tmp_path / "split", tmp_path / "backup"
    begun(folder)
    (folder / FINISHED).write_text("")
    os.link(folder / FINISHED, backup)
    opened(folder)
    with (folder / FINISHED).open("a") as file:
        file.write("more")
    assert backup.read_text() == ""


def test_two_do_not_write_one_split_and_who_is_done_keeps_nobody_out(tmp_path: Path):
    with (
        Ledger(tmp_path, {"count": 1}, {"a": "1"}),
        pytest.raises(GenerateError, match="no generation goes on, found another at work"),
    ):
        opened(tmp_path)
    opened(tmp_path)
    (tmp_path / PLAN).write_text("{")  # what is refused lets go of the folder, too
    for _ in range(2):
        with pytest.raises(GenerateError, match=PLAN):
            opened(tmp_path)
