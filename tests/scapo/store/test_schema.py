# SPDX-License-Identifier: MIT
"""The values that a shard may hold: each impossible one is refused by name, sample and value."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from scapo.store.manifest import Manifest, read_manifest
from scapo.store.schema import LAYOUT, StoreError, check_samples, check_shape, sample_shapes
from tests.helpers.splits import POINTS, sample_arrays, write_split

PATH = Path("data/00001.safetensors")


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> Manifest:
    folder = write_split(tmp_path_factory.mktemp("split"), "eyeglasses")
    return read_manifest(folder / "manifest.json")


def test_the_layout_is_that_of_the_contract(manifest: Manifest) -> None:
    assert {name: kind for name, (kind, _) in LAYOUT.items()} == {
        "points": "float32",
        "color": "uint8",
        "part": "uint8",
        "camera_T_part": "float32",
        "joint_pivot": "float32",
        "joint_axis": "float32",
        "joint_state": "float32",
        "visible": "float32",
        "camera": "float32",
        "instance": "int32",
        "sensor": "float32",
        "alike": "uint8",
        "alike_base": "float32",
        "alike_state": "float32",
        "alike_part": "uint8",
    }
    assert sample_shapes(manifest, 5) == {
        "points": (5, POINTS, 3),
        "color": (5, POINTS, 3),
        "part": (5, POINTS),
        "camera_T_part": (5, 3, 4, 4),
        "joint_pivot": (5, 2, 3),
        "joint_axis": (5, 2, 3),
        "joint_state": (5, 2),
        "visible": (5, 3),
        "camera": (5, 6),
        "instance": (5,),
        "sensor": (5, 3),
        "alike": (5, 24),
        "alike_base": (5, 24, 4, 4),
        "alike_state": (5, 24, 2),
        "alike_part": (5, 24, 3),
    }


def test_possible_samples_pass(manifest: Manifest) -> None:
    arrays = sample_arrays("eyeglasses", 4, 0)
    arrays["visible"][0, 0] = np.nan  # unknown
    arrays["joint_state"][0] = -0.1, np.nan
    arrays["mine"] = np.full((2, 2), np.nan)  # of somebody's own
    check_samples(PATH, arrays, manifest, 10, 4)
    check_samples(PATH, {name: array[:0] for name, array in arrays.items()}, manifest, 10, 0)


def put(name: str, at: tuple[int, ...], value: object) -> Callable[[dict[str, np.ndarray]], None]:
    def change(arrays: dict[str, np.ndarray]) -> None:
        arrays[name][at] = value

    change.__name__ = f"{name}{list(at)}={value}"
    return change


IMPOSSIBLE = [
    (put("points", (2, 5, 1), np.nan), "'points', sample 12[5][1]: expected a finite number"),
    (put("points", (2, 5, 1), -np.inf), "'points', sample 12[5][1]: expected a finite number"),
    (put("part", (3, 0), 3), "'part', sample 13[0]: expected an index below 3 or 255, found 3"),
    (put("part", (3, 0), 254), "expected an index below 3 or 255, found 254"),
    (put("joint_axis", (1, 1), [0.31, 0, 0]), "'joint_axis', sample 11[1]: expected a unit vector"),
    (put("joint_axis", (1, 1), [0.31, 0, 0]), ", found [0.31, 0."),
    (put("joint_axis", (1, 1), np.nan), "expected a unit vector, found [nan, nan, nan]"),
    (put("joint_axis", (1, 1), 3e38), "expected a unit vector"),
    (put("joint_pivot", (0, 0, 2), np.nan), "'joint_pivot', sample 10[0][2]: expected a finite"),
    (put("joint_state", (0, 1), np.inf), "'joint_state', sample 10[1]: expected a finite number"),
    (put("camera_T_part", (1, 2, 0, 0), 7), "'camera_T_part', sample 11[2]: expected a rigid"),
    (put("camera_T_part", (1, 2), 0), "'camera_T_part', sample 11[2]: expected a rigid motion"),
    (put("camera_T_part", (1, 2), np.diag([1, 1, -1, 1])), "expected a rigid motion"),
    (put("camera_T_part", (1, 2), np.diag([2, 2, 2, 1])), "expected a rigid motion"),
    (put("camera_T_part", (1, 2, 3, 0), 1), "expected a rigid motion"),
    (put("camera_T_part", (1, 2, 0, 3), np.inf), "expected a rigid motion"),
    (put("visible", (0, 1), 1.5), "'visible', sample 10[1]: expected a share between 0 and 1"),
    (put("visible", (0, 1), -0.1), "expected a share between 0 and 1, or NaN, found -0.1"),
    (put("camera", (3, 0), 0), "'camera', sample 13: expected fx, fy, cx, cy, width, height"),
    (put("camera", (3, 2), np.nan), "'camera', sample 13: expected fx"),
    (put("camera", (3, 5), -1), "'camera', sample 13: expected fx"),
    (put("instance", (2,), 3), "'instance', sample 12: expected an index below 3, found 3"),
    (put("instance", (2,), -1), "'instance', sample 12: expected an index below 3, found -1"),
    (put("alike", (2, 5), 2), "'alike', sample 12[5]: expected 0 or 1, and 1 for the first turn"),
    (put("alike", (2, 0), 0), "'alike', sample 12[0]: expected 0 or 1, and 1 for the first turn"),
    (put("alike_part", (1, 3), [0, 1, 1]), "'alike_part', sample 11[3]: expected every part once"),
    (put("alike_base", (1, 3), 0), "'alike_base', sample 11[3]: expected a rigid motion"),
    (put("alike_state", (1, 3, 1), np.nan), "'alike_state', sample 11[3][1]: expected a finite"),
]


def samples() -> dict[str, np.ndarray]:
    """Four samples of eyeglasses with the tensors of ambiguity."""
    arrays = sample_arrays("eyeglasses", 4, 0)
    return arrays | {
        "alike": np.tile((np.arange(24) == 0).astype(np.uint8), (4, 1)),
        "alike_base": np.repeat(arrays["camera_T_part"][:, :1], 24, 1),
        "alike_state": np.repeat(arrays["joint_state"][:, None], 24, 1),
        "alike_part": np.tile(np.arange(3, dtype=np.uint8), (4, 24, 1)),
    }


@pytest.mark.parametrize(("change", "message"), IMPOSSIBLE)
def test_impossible_values_are_refused(
    manifest: Manifest, change: Callable[[dict[str, np.ndarray]], None], message: str
) -> None:
    arrays = samples()
    change(arrays)
    with pytest.raises(StoreError) as caught:
        check_samples(PATH, arrays, manifest, 10, 4)
    assert str(caught.value).startswith(f"{PATH}: tensor ")
    assert message in str(caught.value)


@pytest.mark.parametrize("name", LAYOUT)
def test_other_types_and_shapes_are_refused(manifest: Manifest, name: str) -> None:
    arrays = samples()
    arrays["color"] = np.zeros((4, POINTS, 3), np.uint8)
    arrays["sensor"] = np.zeros((4, 3), np.float32)
    good = arrays[name]
    for bad in (good.astype(np.float64), good.astype(np.int64)):
        message = f"tensor '{name}': expected dtype {good.dtype}, found {bad.dtype}"
        with pytest.raises(StoreError, match=message):
            check_samples(PATH, {name: bad}, manifest, 0, 4)
    for bad in (good[:-1], good[..., None], good[None]):
        with pytest.raises(StoreError, match=rf"tensor '{name}': expected shape \(4,"):
            check_samples(PATH, {name: bad}, manifest, 0, 4)


def test_check_shape_with_free_lengths() -> None:
    for array in (np.zeros((4, 7, 3)), torch.zeros(4, 7, 3)):
        check_shape(PATH, "x", array, (4, None, 3))
        check_shape(PATH, "x", array, None)
        with pytest.raises(StoreError) as caught:
            check_shape(PATH, "x", array, (4, None, 2))
        message = "tensor 'x': expected shape (4, '*', 2), found (4, 7, 3)"
        assert str(caught.value) == f"{PATH}: {message}"
        with pytest.raises(StoreError, match="expected shape"):
            check_shape(PATH, "x", array, (None, None))
