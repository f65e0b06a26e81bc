# SPDX-License-Identifier: MIT
"""In place of `bench`: writes what a verb would, from the bytes of what it reads; instantly.

`python -m tests.helpers.fake_bench VERB ... --out FILE`: every file named in the words is read into
a digest, which FILE then holds; FAKE_BENCH names a file that counts the calls, one line each.
A seed of 13 fails; `train` sleeps while the file of FAKE_BENCH with `.slow` is there.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from pathlib import Path


def main(words: list[str]) -> None:
    verb, out = words[0], Path(words[words.index("--out") + 1])
    calls = Path(os.environ["FAKE_BENCH"])
    with calls.open("a") as file:
        file.write(f"{verb} {out.name}\n")
    if "13" in words:
        sys.exit("fake: a seed that brings no luck")
    named = [path for word in words[1:]
             for path in (Path(word), Path(word) / "checkpoint.safetensors")]  # fmt: skip
    read = [path for path in named if path.is_file() and path != out]
    text = " ".join([verb, *(hashlib.sha256(path.read_bytes()).hexdigest() for path in read)])
    file = {"train": out / "checkpoint.safetensors", "explain": out / "ladder.md",
            "pictures": out / "ranking.png"}.get(verb, out)  # fmt: skip
    file.parent.mkdir(parents=True, exist_ok=True)
    if verb == "train":
        (out / "half").write_text("begun")
        while calls.with_suffix(".slow").exists():
            time.sleep(0.05)
    file.write_text(text)


if __name__ == "__main__":
    main(sys.argv[1:])
