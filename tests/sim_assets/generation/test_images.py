# SPDX-License-Identifier: MIT
"""Pictures beside the shards: what a depth camera would save, of the very points of the clouds."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bench.infer.readers import ReadOptions, find_inputs, read_input
from scapo.store import open_split
from sim_assets.generation.generate import Made, Running, make_split
from sim_assets.generation.ledger import GenerateError
from sim_assets.options import DataOptions

OPTIONS = DataOptions(
    count=4, instances=2, points=256, image_size=96, backend="raycast", images=True
)

pytestmark = pytest.mark.usefixtures("raycast")
MILLIMETRE = 0.001


def made(out: Path, options: DataOptions = OPTIONS) -> Made:
    return make_split("oven", options, out, Running(workers=0))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data")
    made(out, replace(OPTIONS, color=True))
    return out


def pictures(data: Path) -> Path:
    return data / "oven" / "train" / "images" / "00000"


def test_each_point_is_a_pixel_of_its_depth_and_part(data: Path) -> None:
    arrays = open_split(data, "oven", "train").arrays("points", "part", "color")
    camera = json.loads((pictures(data) / "intrinsics.json").read_text())
    for i in range(4):
        depth, mask, rgb = (
            np.asarray(Image.open(pictures(data) / f"{i:04d}{suffix}"))
            for suffix in (".png", ".mask.png", ".rgb.png")
        )
        assert depth.dtype == np.uint16
        x, y, z = arrays["points"][i].T.astype(float)
        u = np.floor(x / z * camera["fx"] + camera["cx"]).astype(int)
        v = np.floor(y / z * camera["fy"] + camera["cy"]).astype(int)
        assert np.abs(depth[v, u] * MILLIMETRE - z).max() <= MILLIMETRE / 2 + 1e-6
        assert np.array_equal(mask[v, u], arrays["part"][i] + 1)
        assert np.array_equal(rgb[v, u], arrays["color"][i])
        assert not mask[depth == 0].any()


def test_infer_reads_them_with_camera_and_mask(data: Path) -> None:
    inputs = find_inputs([pictures(data)])
    assert [path.name for path in inputs] == [f"{i:04d}.png" for i in range(4)]
    points = open_split(data, "oven", "train").arrays("points")["points"]
    for path, cloud in zip(inputs, points, strict=True):
        found = read_input(path, ReadOptions())
        assert found.warnings == ()
        gaps = np.linalg.norm(found.points[:, None] - cloud[None], axis=-1).min(0)
        assert gaps.max() < MILLIMETRE


def test_shards_are_the_same_without_and_pictures_can_come_later(tmp_path: Path) -> None:
    folder = tmp_path / "oven" / "train"
    plain = made(tmp_path, replace(OPTIONS, images=False))
    assert not (folder / "images").exists()
    later = made(tmp_path)
    assert later.manifest == plain.manifest
    assert later.kept == 0
    assert made(tmp_path).kept == 1
    shutil.rmtree(folder / "images" / "00000")
    (folder / "images" / ".00000.killed").mkdir()
    assert made(tmp_path).kept == 0
    assert sorted(path.name for path in (folder / "images").iterdir()) == ["00000"]
    (folder / "images" / "00000" / "mine.txt").write_text("kept")
    with pytest.raises(GenerateError, match="images/00000: expected nothing, or what this program"):
        made(tmp_path)


@pytest.mark.parametrize("mask", ["exact", "imperfect"])
def test_the_sensor_acts_on_the_whole_picture_and_leaves_the_cloud_as_it_is(
    tmp_path: Path, mask: str
) -> None:
    noisy = replace(OPTIONS, noise="disparity", mask=mask, image_size=128)
    with_images, without = (
        made(tmp_path / "a", noisy),
        made(tmp_path / "b", replace(noisy, images=False)),
    )
    assert with_images.manifest.digest == without.manifest.digest
    clean = made(tmp_path / "c", replace(OPTIONS, image_size=128))
    shown = [
        np.asarray(Image.open(m.folder / "images" / "00000" / "0000.png")).astype(float)
        for m in (with_images, clean)
    ]
    labels = np.asarray(Image.open(with_images.folder / "images" / "00000" / "0000.mask.png"))
    both = (shown[0] > 0) & (shown[1] > 0)
    assert both.sum() > 0.5 * (shown[1] > 0).sum()
    assert 0 < np.median(np.abs(shown[0] - shown[1])[both]) < 60
    assert bool((labels == 255).any()) is (mask == "imperfect")


def test_other_protocols_have_no_picture(tmp_path: Path) -> None:
    for protocol in ("full", "isolated"):
        with pytest.raises(ValueError, match=f"images: expected protocol joint, found {protocol}"):
            made(tmp_path, replace(OPTIONS, protocol=protocol))
