# SPDX-License-Identifier: MIT
"""`generate --ambiguity`: four tensors more, whoever makes them, and all others as without."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scapo.store import Split, open_split
from scapo.store.schema import ALIKE
from sim_assets.describe.info import describe_split
from sim_assets.generation.generate import Running, generate
from sim_assets.generation.request import make_request
from sim_assets.inspect.preview import draw_preview
from sim_assets.options import DataOptions

OPTIONS = DataOptions(
    split="test", count=8, instances=2, points=1024, preset="sim-art-sensor", noise="disparity",
    mask="imperfect", backend="raycast", ambiguity=True,
)  # fmt: skip
NAMES = ("points", "part", "camera_T_part", "joint_pivot", "joint_axis", "joint_state", "visible")


def make(folder: Path, options: DataOptions, workers: int = 0) -> Split:
    request, assets = make_request("basket", options)
    place = folder / "basket" / "test"
    generate(request, assets, place, {"scapo": "test"}, Running(workers=workers))
    return open_split(folder, "basket", "test")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Split:
    return make(tmp_path_factory.mktemp("data"), OPTIONS)


def test_the_other_tensors_stay_as_they_are(made: Split, tmp_path: Path):
    plain = make(tmp_path, replace(OPTIONS, ambiguity=False))
    for name, array in plain.arrays(*NAMES).items():
        np.testing.assert_array_equal(made.arrays(name)[name], array)
    assert plain.manifest.plan_digest == made.manifest.plan_digest
    assert plain.manifest.digest != made.manifest.digest
    assert "ambiguity" not in plain.manifest.options
    tolerance = {"size": 0.01, "sigmas": 3.0, "share": 0.003, "pixels": 128}
    assert made.manifest.options["ambiguity"] == tolerance


def test_the_number_of_workers_does_not_change_the_bytes(made: Split, tmp_path: Path):
    assert make(tmp_path, OPTIONS, workers=2).manifest.digest == made.manifest.digest


def test_baskets_look_alike_after_half_a_turn_with_their_handles_exchanged(made: Split):
    data = made.arrays(*ALIKE, "camera_T_part", "joint_state")
    others = np.flatnonzero(data["alike"][:, 1:].any(0)) + 1
    assert others.tolist() == [3]
    several = data["alike"][:, 3] == 1
    base, turned = data["camera_T_part"][several, 0], data["alike_base"][several, 3]
    relative = np.swapaxes(base[:, :3, :3], 1, 2) @ turned[:, :3, :3]
    assert np.allclose(relative, np.diag([-1, -1, 1]), atol=0.03)
    exchanged = data["joint_state"][several][:, ::-1]
    assert np.allclose(data["alike_state"][several, 3], exchanged, atol=np.radians(3))
    assert (data["alike_part"][several, 3] == [0, 2, 1]).all()
    np.testing.assert_array_equal(data["alike_base"][:, 0], data["camera_T_part"][:, 0])


def test_info_and_preview_tell_them_apart(made: Split, tmp_path: Path):
    several = (made.arrays("alike")["alike"].sum(1) > 1).sum()
    report = describe_split(made)
    assert report.damage == ""
    assert f"ambiguous  {100 * several / 8:.1f} % of the views" in report.text
    assert "turns 3" in report.text
    drawn = draw_preview(made.folder, tmp_path / "sheet.png", 4, by_ambiguity=True)
    assert drawn == min(2, several) + min(2, 8 - several)


def test_parts_rendered_apart_are_refused():
    with pytest.raises(ValueError, match="expected protocol joint or full, found isolated"):
        make_request("basket", replace(OPTIONS, protocol="isolated"))


def test_whole_surfaces_need_no_renderer(tmp_path: Path):
    options = DataOptions(
        split="test", count=2, instances=1, points=64, protocol="full", ambiguity=True
    )
    alike = make(tmp_path, options).arrays("alike")["alike"]
    assert alike.shape == (2, 24)
    assert (alike[:, 0] == 1).all()
