#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""Scores into an archive of `results` and back.

    python scripts/archive_scores.py pack ARCHIVE.tar.xz OUT [FILE-PATTERN]
    python scripts/archive_scores.py restore OUT ARCHIVE.tar.xz [ARCHIVE.tar.xz ...]

OUT is what `scapo-bench run` filled: `OUT/scores/PART/*.csv.gz` and a report beside each. In an
archive every table lies on its side, one line a column: equal words then stand together, and
values have five significant digits: together a sixth of what it would take. Everything else of a
restored table is the same to the byte; each report is told the digest of what is restored.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import lzma
import sys
import tarfile
from pathlib import Path

from scapo.store.files import sha256_file, write_bytes

DIGITS = 5
"""Of a value: means of a thousand of them, as tables print them, stay what they were."""


def turned(table: str) -> str:
    """A CSV table with its rows as columns; twice gives it back."""
    text = io.StringIO()
    rows = zip(*csv.reader(io.StringIO(table)), strict=True)
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def short(lying: str) -> str:
    """A table on its side with fewer digits of its values."""
    lines = lying.splitlines(keepends=True)
    for number, line in enumerate(lines):
        name, *values = line.rstrip("\n").split(",")
        if name == "value":
            fewer = (format(float(value), f".{DIGITS}g") if value else "" for value in values)
            lines[number] = ",".join((name, *fewer)) + "\n"
    return "".join(lines)


def pack(archive: Path, out: Path, pattern: str = "*") -> int:
    """Archive tables and reports, and say how many tables.

    An archive that is there stays until the new one is whole.
    """
    scores = sorted((out / "scores").rglob(f"{pattern}.csv.gz"))
    if not scores:
        raise ValueError(f"{out}: expected scores/**/{pattern}.csv.gz, found none")
    held = io.BytesIO()
    with tarfile.open(fileobj=held, mode="w:xz", preset=9) as packed:
        for path in scores:
            table = gzip.decompress(path.read_bytes()).decode()
            try:
                lying = turned(table)
            except ValueError:  # rows of different lengths
                lying = ""
            if turned(lying) != table:
                raise ValueError(f"{path}: expected a table written by scapo-bench evaluate")
            report = path.with_name(path.name.removesuffix(".csv.gz") + ".json")
            name = path.relative_to(out).with_suffix("").as_posix()
            _add(packed, name, short(lying).encode())
            _add(packed, report.relative_to(out).as_posix(), report.read_bytes())
    write_bytes(archive, held.getvalue())
    return len(scores)


def _add(packed: tarfile.TarFile, name: str, data: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size = len(data)  # and no time: equal scores give an equal archive
    packed.addfile(member, io.BytesIO(data))


def _extract(packed: tarfile.TarFile, out: Path) -> None:
    """Plain files within `out`; anything else is refused.

    `extractall(filter="data")` does so too, but not before Python 3.11.4 and 3.10.12.
    """
    for member in packed.getmembers():
        path = out / member.name
        if not member.isfile() or out.resolve() not in path.resolve().parents:
            raise ValueError(f"{member.name}: expected a file within the archive's folder")
        held = packed.extractfile(member)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(held.read() if held else b"")


def restore(archive: Path, out: Path) -> int:
    """Unpack one archive and say how many tables it held."""
    try:
        with tarfile.open(archive, "r:xz") as packed:
            names = [out / name for name in packed.getnames() if name.endswith(".csv")]
            _extract(packed, out)
    except (EOFError, lzma.LZMAError, tarfile.TarError) as error:
        raise ValueError(f"{archive}: {error}") from error
    for lying in names:
        scores = lying.with_name(f"{lying.name}.gz")
        with scores.open("wb") as raw, gzip.GzipFile("", "wb", 6, raw, mtime=0) as stream:
            stream.write(turned(lying.read_text()).encode())
        lying.unlink()
        report = lying.with_suffix(".json")
        said = json.loads(report.read_text())
        said["digests"]["scores"] = sha256_file(scores)
        report.write_text(json.dumps(said, indent=1, sort_keys=True) + "\n")
    return len(names)


def main(words: list[str]) -> None:
    """Pack or restore, as the first word says."""
    match words:
        case ["pack", archive, out, *pattern] if len(pattern) < 2:
            print(f"{archive}: {pack(Path(archive), Path(out), *pattern)} tables")
        case ["restore", out, *archives] if archives:
            for archive in archives:
                print(f"{archive}: {restore(Path(archive), Path(out))} tables", flush=True)
        case _:
            sys.exit(__doc__)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except (OSError, ValueError) as error:
        sys.exit(f"archive_scores: {error}")
