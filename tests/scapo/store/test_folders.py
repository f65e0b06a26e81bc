# SPDX-License-Identifier: MIT
"""Folders that replace what they wrote themselves, and nothing else."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from scapo.store import folders
from scapo.store.folders import digests, made_here, whole_folder


def write(folder: Path, text: str) -> None:
    with whole_folder(folder) as place:
        (place / "a").mkdir()
        (place / "a/file").write_text(text)


def state(top: Path) -> dict[str, str]:
    return {
        path.relative_to(top).as_posix(): path.read_text() if path.is_file() else ""
        for path in sorted(top.rglob("*"))
    }


def add_note(folder: Path) -> None:
    write(folder, "one")
    (folder / "notes.txt").write_text("mine")


def add_folder(folder: Path) -> None:
    write(folder, "one")
    (folder / "ideas").mkdir()


def change(folder: Path) -> None:
    write(folder, "one")
    (folder / "a/file").write_text("one, and by hand")


def take_away(folder: Path) -> None:
    write(folder, "one")
    (folder / "a/file").unlink()
    (folder / "a/other").write_text("one")


def add_link(folder: Path) -> None:
    write(folder, "one")
    (folder / "link").symlink_to(folder.parent)


def add_pipe(folder: Path) -> None:
    write(folder, "one")
    os.mkfifo(folder / "pipe")


def foreign(folder: Path) -> None:
    folder.mkdir()
    (folder / "thesis.tex").write_text("years")


def damaged_marker(folder: Path) -> None:
    write(folder, "one")
    (folder / ".made.json").write_text("[" * 100_000)


def list_marker(folder: Path) -> None:
    write(folder, "one")
    (folder / ".made.json").write_text("[]")


def file(folder: Path) -> None:
    folder.write_text("a file")


def link(folder: Path) -> None:
    write(folder.with_name("else"), "one")
    folder.symlink_to(folder.with_name("else"))


def dangling(folder: Path) -> None:
    folder.symlink_to(folder.with_name("nowhere"))


IN_THE_WAY = [add_note, add_folder, change, take_away, add_link, add_pipe, foreign,
              damaged_marker, list_marker, file, link, dangling]  # fmt: skip


@pytest.mark.parametrize("put", IN_THE_WAY, ids=lambda put: put.__name__)
def test_what_is_not_ours_is_refused_and_left_alone(put: Callable[[Path], None], tmp_path: Path):
    put(tmp_path / "out")
    before = state(tmp_path)
    with pytest.raises(ValueError, match="out: expected nothing, or what this program wrote"):
        write(tmp_path / "out", "two")
    assert state(tmp_path) == before


def test_what_was_written_is_replaced(tmp_path: Path):
    for text in ("one", "two", "two"):
        write(tmp_path / "out", text)
        assert (tmp_path / "out/a/file").read_text() == text
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_empty_folder_is_taken(tmp_path: Path):
    (tmp_path / "out").mkdir()
    write(tmp_path / "out", "one")
    assert made_here(tmp_path / "out")


def write_while_somebody_notes(folder: Path) -> None:
    with whole_folder(folder) as place:
        (place / "file").write_text("two")
        (folder / "notes").write_text("mine")


def test_somebody_who_writes_meanwhile_is_not_overwritten(tmp_path: Path):
    write(tmp_path / "out", "one")
    with pytest.raises(ValueError, match="a folder with other files"):
        write_while_somebody_notes(tmp_path / "out")
    assert state(tmp_path)["out/notes"] == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def write_half(folder: Path, error: type[BaseException]) -> None:
    with whole_folder(folder) as place:
        (place / "half").write_text("half")
        raise error


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_what_fails_leaves_nothing_behind(tmp_path: Path, error: type[BaseException]):
    with pytest.raises(error):
        write_half(tmp_path / "out", error)
    assert list(tmp_path.iterdir()) == []  # hidden ones neither


def test_digests_tell_kinds_apart(tmp_path: Path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to("file")
    assert {name: bool(value) for name, value in digests(tmp_path).items()} == {
        "empty/": False,
        "file": True,
        "link": False,
    }


def test_a_place_that_cannot_be_made_is_told_by_the_name_that_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(prefix: str, dir: Path) -> str:  # noqa: A002 - as `mkdtemp` names it
        raise PermissionError(13, "Permission denied", f"{dir}/{prefix}xyz")

    monkeypatch.setattr(folders.tempfile, "mkdtemp", refuse)
    with pytest.raises(OSError, match="Permission denied") as refused:
        write(tmp_path / "out", "one")
    assert refused.value.filename == str(tmp_path / "out")
