# SPDX-License-Identifier: MIT
"""Methods by name: the library's own, those of other packages, and the loader of all."""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from scapo import registry
from scapo.categories import CATEGORIES
from scapo.predictor import load
from scapo.registry import LIBRARY, Method, load_method
from scapo.store.checkpoint import WEIGHTS, checkpoint_header, write_checkpoint
from scapo.store.files import read, write
from scapo.store.schema import StoreError
from tests.helpers.strategies import generator
from tests.helpers.tiny import TINY, tiny
from tests.scapo.training.test_run_folder import REPLACED, altered, places, refusal

CODE = """
from scapo.paper.config import ScapoConfig, cpu_config
from scapo.paper.method import Scapo
from scapo.registry import Method

class Renamed(Scapo):
    name = "renamed"

METHOD = Method(title="Renamed", rank=75, maker=Renamed, presets={"cpu": cpu_config})
OTHER = Method(title="Not mine", rank=0, maker=Renamed, presets={"cpu": cpu_config})
"""
ENTRIES = """[scapo.methods]
renamed = other_methods:METHOD
scapo = other_methods:OTHER
absent = other_methods:NOWHERE
wrong = other_methods:Renamed
broken = broken_methods:METHOD
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package with a method, one with an error at import, and the lines that name them."""
    (tmp_path / "other_methods.py").write_text(CODE)
    (tmp_path / "broken_methods.py").write_text("raise RuntimeError('no\\nGPU')\n")
    info = tmp_path / "other_methods-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-methods\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRIES)
    monkeypatch.syspath_prepend(tmp_path)
    registry.external.cache_clear()
    yield tmp_path
    registry.external.cache_clear()
    sys.modules.pop("other_methods", None)


def test_methods_of_other_packages_are_known_and_broken_ones_cost_a_line(
    package: Path, caplog: pytest.LogCaptureFixture
) -> None:
    del package
    with caplog.at_level(logging.WARNING):
        methods = registry.known()
        assert registry.known() == methods
    assert list(methods) == [*LIBRARY, "renamed"]
    assert methods["renamed"].title == "Renamed"
    assert methods["scapo"] is LIBRARY["scapo"]
    lines = sorted(record.getMessage() for record in caplog.records)
    assert [line.split()[2] for line in lines] == ["absent", "broken", "wrong"]
    assert all("expected a scapo.registry.Method, found" in line for line in lines)
    assert lines[1].endswith("found RuntimeError: no GPU")


def test_a_model_of_another_package_is_loaded_by_its_name(package: Path) -> None:
    entry = registry.known()["renamed"]
    model = entry.build(TINY, CATEGORIES["laptop"], generator(0))
    write_checkpoint(package / WEIGHTS, model, checkpoint_header("renamed", TINY, "laptop", {}))
    found = load(package)
    assert type(found.model) is type(model)
    assert found.predict(np.random.default_rng(0).normal(size=(96, 3))).part_weight.shape == (96, 2)
    known = "expected a method of scapo, registered, registered-labelled, found 'renamed'"
    with pytest.raises(StoreError, match=known):
        load_method(package, LIBRARY)


@pytest.mark.parametrize("name", LIBRARY)
def test_the_words_of_a_line_are_those_of_what_they_name(name: str) -> None:
    entry = LIBRARY[name]
    for preset in entry.presets:
        model = entry.build(entry.preset(preset), CATEGORIES["eyeglasses"], generator(0))
        assert model.name == name
        assert isinstance(model.config, entry.kind)
        assert model.supervision == frozenset(entry.supervision)
    assert entry.preset("of another method") == entry.preset(None)


def test_a_line_may_hold_what_it_names() -> None:
    entry = Method(title="T", rank=1, maker=lambda *_: tiny(), presets={"one": lambda: TINY})
    assert entry.kind is type(TINY)
    assert entry.preset(None) is TINY
    assert entry.build(TINY, CATEGORIES["laptop"], generator(0)).name == "scapo"


def test_the_lines_are_read_without_torch() -> None:
    code = "import sys, bench.methods, scapo.registry; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    header = checkpoint_header("scapo", TINY, "laptop", {"seed": 1, "steps": 2, "machine": {}})
    write_checkpoint(tmp_path / WEIGHTS, tiny(), header)
    return tmp_path / WEIGHTS


def test_any_damaged_header_is_one_line_with_the_file(saved: Path) -> None:
    arrays, header = read(saved)
    refused = 0
    for number, place in enumerate(places(header)):
        value = REPLACED[number % len(REPLACED)] if number % 2 else ...  # left out
        write(saved, arrays, altered(header, place, value))
        said = refusal(load_method, saved)
        assert not said or (said.startswith(str(saved)) and "\n" not in said)
        refused += said != ""
    assert refused > 30


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_weights_that_are_not_finite_are_refused(saved: Path, value: float) -> None:
    arrays, header = read(saved)
    name = "encoder.pose.weight"
    arrays[name].flat[3] = value
    write(saved, arrays, header)
    with pytest.raises(StoreError, match=rf"tensor '{name}': expected finite numbers"):
        load(saved)


def test_an_unknown_category_is_named_with_the_file(saved: Path) -> None:
    arrays, header = read(saved)
    write(saved, arrays, {**header, "category": "teapot"})
    with pytest.raises(StoreError, match=r"category: expected one of laptop, .* found 'teapot'"):
        load(saved)
