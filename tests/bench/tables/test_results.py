# SPDX-License-Identifier: MIT
"""Scores on disk: what is read, and what is refused."""

from __future__ import annotations

import gzip
from dataclasses import replace

import numpy as np
import pytest

from bench.scoring.score_files import read_scores, side_file
from bench.tables import write as tables
from bench.tables.model import Cell
from bench.tables.results import Sampled, Series, averaged, kind_of, load, series_of
from scapo.store import StoreError
from tests.helpers.scored import SAMPLES, make_scores


def test_series_and_kinds(tmp_path):
    make_scores(tmp_path, "scapo", "laptop", variant="cpu[iou=soft,label-order=dataset]")
    (path,) = tmp_path.glob("*.csv.gz")
    (scores,) = read_scores(path)
    assert series_of(scores) == Series("scapo", "cpu", "iou=soft,label-order=dataset")
    kinds = {
        "clean@1": "clean", "sim-art/1/sensor@2": "sensor", "op-align-real@3": "sensor",
        "x@4": "clean", "complete@5": "complete", "sim-art/2/complete@6": "complete",
        "real@7": "real", "isolated@8": "isolated", "my-isolated@9": "isolated",
        "surreal@10": "clean",
    }  # fmt: skip
    assert {name: kind_of(name) for name in kinds} == kinds
    assert scores.instance[:9].tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 0]


def test_what_is_written_is_read(tmp_path):
    errors = make_scores(tmp_path, "scapo", "eyeglasses")
    (path,) = tmp_path.glob("*.csv.gz")
    (scores,) = read_scores(path)
    assert set(scores.errors) == set(errors)
    for key, value in errors.items():
        assert scores.errors[key] == pytest.approx(value, rel=1e-8, nan_ok=True)


def test_two_data_sets_are_not_mixed(tmp_path):
    make_scores(tmp_path, "scapo", "laptop")
    make_scores(tmp_path, "icp", "laptop", digest="ffffffffffff")
    with pytest.raises(StoreError, match=r"expected scores on clean@.* like .*, found clean@"):
        load(tmp_path)


def test_states_in_degrees_and_in_centimetres_have_no_mean():
    turns = Sampled(cell=Cell(value=4.0), means=np.ones(3), per_seed={1: 4.0}, unit="deg")
    assert averaged([turns, turns]).value == 4
    assert averaged([turns, replace(turns, unit="m")]).value is None


def test_a_mean_over_categories_deviates_by_its_seeds_not_by_their_places():
    """Seeds 1 and 2 of one and 2 and 1 of the other: 2 and 5 on the mean, 2.12 apart."""
    one, other = (
        Sampled(cell=Cell(value=3.5), means=np.ones(3), per_seed=found)
        for found in ({1: 1.0, 2: 6.0}, {2: 4.0, 1: 3.0})
    )
    assert averaged([one, other]).deviation == pytest.approx(3 / 2**0.5)
    assert averaged([one, replace(other, per_seed={2: 4.0, 3: 3.0})]).deviation is None


def test_a_run_is_not_counted_twice(tmp_path):
    make_scores(tmp_path / "a", "scapo", "laptop")
    make_scores(tmp_path / "b", "scapo", "laptop")
    with pytest.raises(StoreError, match="expected one scores file per run, found seed 1 also"):
        load(tmp_path)


def test_seeds_must_share_their_samples(tmp_path):
    make_scores(tmp_path, "scapo", "laptop", seed=1)
    make_scores(tmp_path, "scapo", "laptop", seed=2, samples=SAMPLES - 1)
    with pytest.raises(StoreError, match="expected the 40 samples of"):
        tables.build(load(tmp_path))


@pytest.mark.parametrize("damage", ["no gzip", "columns", "metric", "doubled", "text", "json"])
def test_damaged_scores_are_refused(damage, tmp_path):
    make_scores(tmp_path, "scapo", "laptop")
    (path,) = tmp_path.glob("*.csv.gz")
    text = gzip.decompress(path.read_bytes()).decode()
    lines = text.splitlines(keepends=True)
    changed = {
        "columns": text.replace("metric,slot", "slot,metric", 1),
        "metric": text.replace(",iou,", ",area,"),
        "doubled": text + lines[-1],
        "text": text.replace(lines[5], lines[5].rsplit(",", 2)[0] + ",much,deg\n"),
    }
    if damage in changed:
        path.write_bytes(gzip.compress(changed[damage].encode()))
    elif damage == "json":
        side_file(path).write_text("{")
    else:
        path.write_bytes(text.encode())
    with pytest.raises(StoreError, match="expected") as caught:
        read_scores(path)
    assert "\n" not in str(caught.value)
