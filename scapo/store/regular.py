# SPDX-License-Identifier: MIT
"""Files that others made, read with care: regular ones of sane size, and nothing that never ends.

A name may stand for a pipe that nobody writes to, for a device or for a sparse file of terabytes.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

MAX_BYTES = 1 << 30
"""Of a file that is read whole, where its reader has no bound of its own."""

NOT_OWN = "expected a file of its own, found a link, a folder or a device"


def is_odd(path: Path) -> bool:
    """Whether a record's name stands for something else than a file beside the data.

    A link leads to other people's files, a pipe or a device nowhere.
    """
    return path.is_symlink() or (path.exists() and not path.is_file())


def read_regular(path: Path, limit: int = MAX_BYTES) -> bytes:
    """The bytes of a file, links followed.

    Raises:
        OSError: None there, unreadable, no regular file, or of more than `limit` bytes; `strerror`
            says which.
    """
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | getattr(os, "O_NONBLOCK", 0))
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            if stat.S_ISDIR(found.st_mode):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            raise OSError(errno.EINVAL, "a pipe, a socket or a device", str(path))
        if found.st_size > limit:
            words = f"{found.st_size} bytes, more than {limit}"
            raise OSError(errno.EFBIG, words, str(path))
        with os.fdopen(handle, "rb", closefd=False) as file:
            return file.read(found.st_size)  # not of the limit: so much would be set aside first
    finally:
        os.close(handle)
