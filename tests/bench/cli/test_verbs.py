# SPDX-License-Identifier: MIT
"""The command line starts without what only the work needs."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from importlib.metadata import version

import pytest

from bench.cli.verbs import VERBS

HEAVY = ("torch", "pandas", "matplotlib", "scipy", "tensorboard", "sapien")
PROGRAM = """
import sys
from {package}.__main__ import main
try:
    main({words})
except SystemExit as end:
    print("ended", end.code, sorted(set(sys.modules) & set({heavy})))
"""


@pytest.mark.parametrize(
    "words",
    [["--help"], ["--version"], *([verb, "--help"] for verb in VERBS if verb != "train")],
    ids=" ".join,
)
@pytest.mark.parametrize("package", ["bench"])
def test_help_loads_nothing_heavy(package, words, repository):
    code = PROGRAM.format(package=package, words=words, heavy=HEAVY)
    environment = {**os.environ, "COLUMNS": "200", "TERM": "dumb"}
    done = subprocess.run([sys.executable, "-c", code], cwd=repository, env=environment,
                          capture_output=True, text=True, check=True)  # fmt: skip
    assert done.stdout.splitlines()[-1] == "ended 0 []"


def test_tables_need_no_networks_to_refuse(repository, tmp_path):
    code = PROGRAM.format(package="bench", words=["tables", "--scores", str(tmp_path / "none")],
                          heavy=("tensorboard", "matplotlib", "sapien"))  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code], cwd=repository, capture_output=True,
                          text=True, check=True)  # fmt: skip
    assert done.stdout.splitlines()[-1] == "ended 1 []"


@pytest.mark.parametrize("package", ["bench", "sim_assets"])
def test_the_version_is_that_of_the_package(package, repository):
    done = subprocess.run([sys.executable, "-m", package, "--version"], cwd=repository,
                          capture_output=True, text=True, check=True)  # fmt: skip
    name = {"bench": "scapo-bench", "sim_assets": "scapo-data"}[package]
    assert done.stdout == f"{name} {version('scapo')}\n"


def test_a_verb_is_a_frozen_dataclass_whose_fields_are_explained():
    for name, verb in VERBS.items():
        kind = getattr(verb, "__origin__", verb)
        assert kind.__dataclass_params__.frozen, name
        assert kind.__doc__.strip()
        assert dataclasses.fields(kind)
