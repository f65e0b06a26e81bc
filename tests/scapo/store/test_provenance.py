# SPDX-License-Identifier: MIT
"""A result names the code and the machine, and neither a path nor a host."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from scapo.store import provenance


def git(folder: Path, *words: str) -> str:
    name = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    done = subprocess.run(
        ["git", *name, *words], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A repository with the package folder in it; returns that folder."""
    package = tmp_path / "scapo"
    package.mkdir()
    (package / "a.py").write_text("1\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "one")
    return package


def described(package: Path) -> str:
    return provenance.commit.__wrapped__(package)


def test_a_checkout_is_named_by_its_commit(checkout: Path) -> None:
    head = git(checkout, "rev-parse", "HEAD")
    assert described(checkout) == head[:12]
    (checkout / "a.py").write_text("2\n")
    assert described(checkout) == f"{head[:12]}-dirty"


def test_a_package_somewhere_inside_another_repository_is_a_version(checkout: Path) -> None:
    inner = checkout / "site-packages" / "scapo"
    inner.mkdir(parents=True)
    assert described(inner).startswith("version ")


def test_without_git_it_is_a_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert described(tmp_path).startswith("version ")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert provenance.commit.__wrapped__(provenance.PACKAGE).startswith("version ")


def test_the_machine_without_its_name() -> None:
    found = provenance.machine()
    assert found["torch"] == torch.__version__
    assert found["threads"] == torch.get_num_threads()
    assert found["cpu"]
    text = json.dumps(found)
    assert platform.node() not in text or not platform.node()
    assert str(Path.home()) not in text or str(Path.home()) == "/"


def test_the_processor_is_read_where_the_system_lists_it(tmp_path: Path) -> None:
    listing = tmp_path / "cpuinfo"
    listing.write_text("processor : 0\nmodel name\t: Fast One 3 GHz\n")
    assert provenance.processor(listing) == "Fast One 3 GHz"
    assert provenance.processor(tmp_path / "none") == platform.processor() or platform.machine()


def test_peak_memory_counts_what_was_freed_and_the_processes_that_ended() -> None:
    told = "import sys; from scapo.store.provenance import peak_memory as p\n"
    bare, own, child = (
        int(subprocess.run([sys.executable, "-c", told + code + "print(p())"],
                           capture_output=True, text=True, check=True).stdout)
        for code in (
            "",
            "a = bytearray(b'1') * 700_000_000; del a\n",
            "import subprocess\nsubprocess.run([sys.executable, '-c',"
            " 'a = b\"1\" * 900_000_000'])\n",
        )
    )  # fmt: skip
    assert 7e8 < own < bare + 8e8
    assert 9e8 < child < 1e9
