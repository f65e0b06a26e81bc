# SPDX-License-Identifier: MIT
"""What is no regular file of sane size is refused at once, never read without end."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

import pytest

from scapo.store.regular import read_regular


def test_files_are_read_and_links_followed(tmp_path: Path):
    (tmp_path / "a").write_bytes(b"\0text")
    (tmp_path / "b").symlink_to("a")
    assert read_regular(tmp_path / "a", 5) == read_regular(tmp_path / "b") == b"\0text"


@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "folder", "sparse", "loop", "none"])
def test_what_is_refused(kind: str, tmp_path: Path):
    path = tmp_path / "x"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as ear:
            ear.bind(str(path))
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "sparse":
        path.touch()
        os.truncate(path, 1 << 40)
    started = time.monotonic()
    with pytest.raises(OSError, match=r".") as caught:
        read_regular(path)
    assert time.monotonic() - started < 5
    assert caught.value.strerror
    assert caught.value.filename == str(path)
