# SPDX-License-Identifier: MIT
"""Fixtures for all tests."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples each time, and no clock: a busy machine is no failure.
settings.register_profile("scapo", deadline=None, derandomize=True)
settings.load_profile("scapo")

# One thread each, set before numpy and torch are imported: tests run in one process per core.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# Started in the background by a shell without job control, Ctrl-C is ignored here and in every
# command that a test starts; the tests of interruption need it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def repository() -> Path:
    """The repository's top folder."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder `shared` beside the repository (fixtures, real models); skips where absent."""
    folder = REPOSITORY.parent / "shared"
    if not (folder / "fixtures").is_dir():
        pytest.skip(f"no folder {folder.name!r} with fixtures beside the repository")
    return folder


@pytest.fixture(scope="session")
def update_golden(request: pytest.FixtureRequest) -> bool:
    """Whether to write golden files anew: `pytest --update-golden`; review the difference."""
    return bool(request.config.getoption("--update-golden"))


@pytest.fixture(scope="session")
def raycast() -> None:
    """For tests that render by casting rays; skips where Embree is not installed."""
    pytest.importorskip("embreex")


@pytest.fixture
def shapes_checked(request: pytest.FixtureRequest) -> None:
    """For tests of what the checker refuses: skipped where it is off, as in `make coverage`."""
    if not request.config.getoption("--jaxtyping-packages"):
        pytest.skip("shapes are unchecked in this run")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--update-golden`."""
    parser.addoption("--update-golden", action="store_true", help="write tests/golden anew")
