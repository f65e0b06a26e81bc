# SPDX-License-Identifier: MIT
"""A folder of files that appears whole, and replaces only what this program wrote itself.

`.made.json` in the folder names its files with their SHA-256. A folder without it, or in which a
file was added, changed or taken away since, is somebody's work: it is refused and left alone.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

from scapo.store.files import canonical_json, sha256_file
from scapo.store.json_records import MAX_JSON, parse_json
from scapo.store.regular import read_regular
from scapo.store.schema import StoreError

MADE = ".made.json"
FORMAT = "scapo-folder/1"
OURS = "what this program wrote"


@contextmanager
def alone(folder: Path, work: str) -> Iterator[None]:
    """Keep others out of a folder, which is made; who was killed keeps nobody out.

    Args:
        folder: On a file system without locks nobody is kept out.
        work: What goes on there, for the error.

    Raises:
        StoreError: It goes on there already.
    """
    folder.mkdir(parents=True, exist_ok=True)
    held = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StoreError(
                f"{folder}: expected a folder in which no {work} goes on, found another at work "
                "there"
            ) from error
        except OSError:  # no locks here
            pass
        yield
    finally:
        os.close(held)


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder that gets the name `folder` at the end, unless an error is raised.

    Raises:
        ValueError: Something is in the way that is not `made_here`.
        OSError: It cannot be written, and which file.
    """
    refuse_foreign(folder, made_here)
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    except OSError as error:  # it names a folder that nobody asked for
        raise OSError(error.errno, error.strerror, str(folder)) from error
    try:
        temporary.chmod(0o755)
        yield temporary
        record = {"format": FORMAT, "files": digests(temporary)}
        (temporary / MADE).write_text(canonical_json(record) + "\n", encoding="utf-8")
        swap(temporary, folder, made_here)
    except OSError as error:  # a full disk is reported without a name, or with the temporary one
        name = str(error.filename or temporary).replace(str(temporary), str(folder), 1)
        raise OSError(error.errno, error.strerror or str(error), name) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def swap(temporary: Path, folder: Path, known: Callable[[Path], bool], what: str = OURS) -> None:
    """Give a finished folder its name; what is there is moved aside first, then removed.

    Raises:
        ValueError: As `refuse_foreign`.
    """
    refuse_foreign(folder, known, what)
    old = temporary.with_name(f"{temporary.name}.old")
    if folder.exists():
        folder.replace(old)
    temporary.replace(folder)
    if old.exists():
        shutil.rmtree(old)


def refuse_foreign(folder: Path, known: Callable[[Path], bool], what: str = OURS) -> None:
    """Refuse a target that is a link, a file, or a folder that `known` denies, empty ones apart.

    Raises:
        ValueError: Naming folder, `what` may be there and what was found.
    """
    if folder.is_symlink():
        found = "a link"
    elif not folder.exists():
        return
    elif not folder.is_dir():
        found = "a file"
    elif not any(folder.iterdir()) or known(folder):
        return
    else:
        found = "a folder with other files, or with files that were changed; it is left alone"
    raise ValueError(f"{folder}: expected nothing, or {what}, found {found}")


def refuse_inside(target: Path, *sources: Path) -> None:
    """Refuse a target that lies in what is read, or around it: it would overwrite originals.

    Raises:
        ValueError: Naming both.
    """
    place = Path(os.path.realpath(target))
    for source in sources:
        real = Path(os.path.realpath(source))  # a link in a circle is itself
        if place == real or real in place.parents or place in real.parents:
            raise ValueError(f"{target}: expected a place outside the source, found it in {source}")


def made_here(folder: Path) -> bool:
    """Whether `whole_folder` wrote this folder and nothing in it has changed since."""
    marker = folder / MADE
    if marker.is_symlink() or not marker.is_file():
        return False
    try:
        record: object = parse_json(read_regular(marker, MAX_JSON))
    except (OSError, ValueError, RecursionError):
        return False
    if not isinstance(record, dict):
        return False
    fields = cast("dict[str, object]", record)
    return fields.get("format") == FORMAT and fields.get("files") == digests(folder)


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of each file below a folder but the marker's; "" for what is neither file nor folder.

    Empty folders count too, as names that end in "/".
    """
    found: dict[str, str] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name == MADE:
            continue
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            found[name] = ""
        elif path.is_file():
            found[name] = sha256_file(path)
        elif not any(path.iterdir()):
            found[f"{name}/"] = ""
    return found
