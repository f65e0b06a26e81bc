#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""Scores from the archives of `results`, as `scapo-bench tables` reads them.

    python scripts/restore_scores.py results/sim-art-2/test/scores-*.tar.xz OUT

The archives hold plain CSV, which packs several times as well together. Each is compressed anew,
and the report beside it is told the digest of what that gives here.
"""

from __future__ import annotations

import gzip
import json
import sys
import tarfile
from pathlib import Path

from scapo.store.files import sha256_file


def restore(archive: Path, out: Path) -> int:
    """Unpack one archive and say how many files of scores it held."""
    with tarfile.open(archive) as packed:
        names = [out / name for name in packed.getnames() if name.endswith(".csv")]
        packed.extractall(out, filter="data")
    for plain in names:
        scores = plain.with_name(f"{plain.name}.gz")
        with scores.open("wb") as raw, gzip.GzipFile("", "wb", 6, raw, mtime=0) as stream:
            stream.write(plain.read_bytes())
        plain.unlink()
        report = plain.with_suffix(".json")
        said = json.loads(report.read_text())
        said["digests"]["scores"] = sha256_file(scores)
        report.write_text(json.dumps(said, indent=1, sort_keys=True) + "\n")
    return len(names)


def main() -> None:
    """Unpack all."""
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    *archives, out = map(Path, sys.argv[1:])
    for archive in archives:
        print(f"{archive.name}: {restore(archive, out)} files of scores")


if __name__ == "__main__":
    main()
