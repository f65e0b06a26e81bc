# SPDX-License-Identifier: MIT
"""What is packaged: scripts, extras, versions, and that the lock files cover them."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import pytest

from sim_assets.rendering.doctor import PACKAGES

tomllib = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")

EXTRAS = {"sim", "gpu-sim", "bench", "view", "export", "cluster", "kiss-matcher", "onnx", "all"}


@pytest.fixture(scope="module")
def pyproject(repository: Path) -> dict[str, Any]:
    return tomllib.loads((repository / "pyproject.toml").read_text())


def name_of(requirement: str) -> str:
    """`pyright[nodejs]>=1.1; marker` -> `pyright`, normalised."""
    match = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert match, requirement
    return re.sub(r"[-_.]+", "-", match[0]).lower()


def locked(path: Path) -> dict[str, list[str]]:
    """Versions by package; several where they differ between Pythons."""
    found: dict[str, list[str]] = {}
    for line in path.read_text().splitlines():
        if line and not line.startswith("#"):
            name, version = line.split(";")[0].strip().split("==")
            found.setdefault(name_of(name), []).append(version)
    return found


@pytest.mark.parametrize("script", ["scapo-data", "scapo-bench"])
def test_console_scripts(pyproject: dict[str, Any], script: str):
    module, function = pyproject["project"]["scripts"][script].split(":")
    assert callable(getattr(import_module(module), function))
    installed = {e.name: e.value for e in metadata.entry_points(group="console_scripts")}
    assert installed[script] == f"{module}:{function}"


@pytest.mark.parametrize("script", ["scapo-data", "scapo-bench"])
def test_console_scripts_refuse_unknown_words(script: str):
    command = [Path(sys.executable).parent / script, "no-such-verb"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert "no-such-verb" in done.stdout + done.stderr


def test_all_is_the_union_of_the_extras(pyproject: dict[str, Any]):
    extras = pyproject["project"]["optional-dependencies"]
    assert set(extras) == EXTRAS
    assert extras["all"] == ["scapo[sim,gpu-sim,bench,view,export,cluster,kiss-matcher,onnx]"]


def test_doctor_lists_what_the_extras_bring(pyproject: dict[str, Any]):
    declared = {"core": pyproject["project"]["dependencies"]}
    declared |= pyproject["project"]["optional-dependencies"]
    for extra, packages in PACKAGES.items():
        assert set(packages) <= {name_of(r) for r in declared[extra]}, extra


def test_packages_are_typed(repository: Path, pyproject: dict[str, Any]):
    packages = pyproject["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert sorted(packages) == ["bench", "scapo", "sim_assets"]
    assert all((repository / package / "py.typed").exists() for package in packages)


def test_the_version_is_the_same_everywhere(repository: Path, pyproject: dict[str, Any]):
    version = pyproject["project"]["version"]
    assert metadata.version("scapo") == version
    assert f"\nversion: {version}\n" in (repository / "CITATION.cff").read_text()


@pytest.mark.parametrize(
    ("lock", "extras"),
    [
        ("requirements.lock", ("sim", "bench", "view")),
        ("requirements-all.lock", ("sim", "bench", "view", "gpu-sim", "cluster", "kiss-matcher")),
    ],
)
def test_the_lock_covers_what_is_declared(
    repository: Path, pyproject: dict[str, Any], lock: str, extras: tuple[str, ...]
):
    declared = [*pyproject["project"]["dependencies"], *pyproject["dependency-groups"]["dev"]]
    for extra in extras:
        declared += pyproject["project"]["optional-dependencies"][extra]
    names = {name_of(requirement) for requirement in declared} - {"scapo"}
    assert names - set(locked(repository / lock)) == set()


def test_the_locks_agree(repository: Path):
    small, large = (locked(repository / f"requirements{x}.lock") for x in ("", "-all"))
    assert small["torch"] == ["2.13.0"]
    assert {name: versions for name, versions in small.items() if large[name] != versions} == {}
