# SPDX-License-Identifier: MIT
"""OP-Align's clouds: damaged files are named with the reason, in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_assets.importers.sets import import_set
from tests.helpers import boxes, foreign

Record = dict[str, Any]


def without(key: str) -> Callable[[Record], object]:
    return lambda record: {k: v for k, v in record.items() if k != key}


def put(key: str, value: Callable[[np.ndarray], object]) -> Callable[[Record], object]:
    return lambda record: {**record, key: value(np.asarray(record[key]))}


def at(*index: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array = array.astype(np.float64)
        array[index] = value
        return array

    return change


BAD_REAL = {
    "no dict": (lambda _: [1, 2], "expected a dict of arrays, found ndarray"),
    "no key": (without("joint"), "expected the key 'joint', found color, detection, part"),
    "shape": (put("pc", lambda a: a[:100]), r"'pc' as numbers of shape \(307200, 3\), found"),
    "dtype": (put("part", lambda a: a.astype(str)), r"'part' as numbers of shape \(P, 15\)"),
    "objects": (put("joint", lambda a: a.astype(object)), "'joint' as numbers"),
    "parts": (put("part", lambda a: a[:1]), "2 parts and 1 joints of 'laptop', found 1 and 1"),
    "nan": (put("joint", at(0, 1, value=np.nan)), "finite numbers in 'joint'"),
    "no rotation": (put("part", at(1, 4, value=5)), "a rotation of part 1 in 'part'"),
    "mirrored": (put("part", lambda a: a * np.repeat([-1.0, 1], [9, 6])), "rotation of part 0"),
    "no direction": (
        put("joint", lambda a: a * np.repeat([1.0, 0], 3)),
        "directions with a length",
    ),
    "label": (put("segmentation", lambda a: a * 7), "whole numbers from 0 to 2"),
    "half label": (put("segmentation", lambda a: a * 0.5), "whole numbers from 0 to 2"),
    "nothing detected": (put("detection", np.zeros_like), "points inside 'detection', found none"),
}


@pytest.fixture(scope="module")
def real() -> Record:
    return foreign.real_record(foreign.view_of(boxes.laptop(), [0.5], seed=1, count=300), np.eye(3))


@pytest.mark.parametrize("name", BAD_REAL)
def test_bad_real_files_are_named_with_the_reason(name: str, real: Record, tmp_path: Path):
    change, message = BAD_REAL[name]
    path = foreign.write_npz(change(real), tmp_path / "laptop_output/train/a/b/input_2/1.npz")
    with pytest.raises(ValueError, match=message) as caught:
        import_set(
            "op-align-real", tmp_path, tmp_path.with_name(f"{tmp_path.name}-out"), strict=True
        )
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert not (tmp_path.with_name(f"{tmp_path.name}-out")).exists()


BAD_LIGHT = {
    "no dict": (lambda _: [1, 2], "expected a dict of arrays, found list"),
    "no key": (without("pose_segs"), "expected the key 'pose_segs', found af_pc"),
    "transposed": (put("pc", lambda a: a.T.copy()), r"'pc' as numbers of shape \(N, 3\)"),
    "label": (put("label", lambda a: a + 1), "whole numbers from 0 to 1 in 'label', found 1 to 2"),
    "labels": (put("label", lambda a: a[:5]), r"'label' as numbers of shape \(128\)"),
    "pivots": (put("part_pv_point", lambda a: a[:, :2]), "'part_pv_point' as numbers"),
    "joints": (put("part_axis", lambda a: np.repeat(a, 2, 0)), "2 parts and 1 joints"),
    "last row": (put("pose_segs", at(0, 3, 1, value=1)), "0 0 0 1 or 0 0 0 0 as last rows"),
    "two bases": (put("pose_segs", at(1, 3, 3, value=0)), "one part that stands still"),
    "rotation": (put("pose_segs", at(0, 0, 0, value=4)), "a rotation of part 0"),
    "empty": (
        lambda r: {**r, "pc": np.zeros((0, 3)), "label": np.zeros(0)},
        "points in 'pc', found none",
    ),
}


@pytest.mark.parametrize("name", BAD_LIGHT)
def test_bad_light_files_are_named_with_the_reason(name: str, tmp_path: Path):
    change, message = BAD_LIGHT[name]
    view = foreign.view_of(boxes.laptop(), [0.5], seed=1, count=128)
    record = change(foreign.light_record(view, np.eye(3), 0.42, (0, 1)))
    path = foreign.write_pt(record, tmp_path / "full/laptop_h/train/0.pt")
    with pytest.raises(ValueError, match=message) as caught:
        import_set(
            "op-align-light", tmp_path, tmp_path.with_name(f"{tmp_path.name}-out"), strict=True
        )
    assert str(caught.value).startswith(f"{path}: ")
    assert not (tmp_path.with_name(f"{tmp_path.name}-out")).exists()
