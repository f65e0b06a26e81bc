# SPDX-License-Identifier: MIT
"""External sets of models: folders in their layouts come back as the object they were made of."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from sim_assets.importers.models import our_category
from sim_assets.importers.sets import CLOUDS, MODELS, Imported, import_set
from sim_assets.models import reader
from sim_assets.procedural import generate
from tests.helpers import boxes, foreign
from tests.helpers.foreign import assert_same

S2M = {
    "oven": "oven",
    "washing_machine": "washer",
    "laptop": "laptop",
    "eyeglasses": "eyeglasses",
    "safe": "safe",
    "suitcase": "suitcase",
}


@pytest.mark.parametrize("name", S2M)
def test_shape2motion(name: str, tmp_path: Path):
    obj = generate(S2M[name], "train", 3, 0)
    foreign.shape2motion(obj, tmp_path / "set", name)
    made = import_set("shape2motion", tmp_path / "set", tmp_path / "out")
    urdf = tmp_path / "out" / S2M[name] / "0001" / "mobility.urdf"
    assert made == Imported(written=[urdf])
    found = reader.read(urdf, S2M[name], root=tmp_path / "out")
    assert_same(found, obj)
    assert found.upper == pytest.approx([joint.upper for joint in obj.category.joints])


@pytest.mark.parametrize("name", ["Laptop", "safe", "oven", "eyeglasses"])
def test_hoi4d(name: str, tmp_path: Path):
    obj = generate(name.lower(), "train", 3, 1)
    foreign.hoi4d(obj, tmp_path / "set", name)
    made = import_set("hoi4d", tmp_path / "set", tmp_path / "out")
    urdf = tmp_path / "out" / name.lower() / "001" / "mobility.urdf"
    assert made == Imported(written=[urdf])
    found = reader.read(urdf, name.lower(), root=tmp_path / "out")
    assert_same(found, obj)
    np.testing.assert_allclose(found.upper, obj.upper, atol=1e-6)


def test_all_real_partnet_models(shared_dir: Path, tmp_path: Path):
    """What the reader takes of the real models is imported; the rest is named."""
    made = import_set("partnet-mobility", shared_dir / "assets" / "stapler", tmp_path)
    assert len(made.written) == 2
    assert made.refused == {}
    made = import_set("partnet-mobility", shared_dir / "assets" / "quirks", tmp_path)
    assert any("all_fixed" in name for name in made.refused)


def test_one_bad_model_costs_itself_alone(tmp_path: Path):
    obj = boxes.laptop()
    for number in ("0001", "0002", "0003"):
        folder = foreign.shape2motion(obj, tmp_path / "set", "laptop", number)
    bad = folder.with_name("0002")
    (bad / "motion_attributes.json").unlink()
    made = import_set("shape2motion", tmp_path / "set", tmp_path / "out")
    assert [path.parent.name for path in made.written] == ["0001", "0003"]
    assert list(made.refused) == [str(bad)]
    assert "motion_attributes.json: expected a readable file" in made.refused[str(bad)]
    assert sorted(p.name for p in (tmp_path / "out" / "laptop").iterdir()) == ["0001", "0003"]
    with pytest.raises(ValueError, match="0002"):
        import_set("shape2motion", tmp_path / "set", tmp_path / "strict", strict=True)


def test_two_models_of_one_name_are_no_silent_loss(tmp_path: Path):
    for root in ("a", "b"):
        foreign.shape2motion(boxes.laptop(), tmp_path / "set" / root, "laptop")
    made = import_set("shape2motion", tmp_path / "set", tmp_path / "out")
    assert len(made.written) == 1
    assert "one model laptop/0001" in next(iter(made.refused.values()))


@pytest.mark.parametrize("name", [*CLOUDS, *MODELS])
def test_nothing_to_import(name: str, tmp_path: Path):
    with pytest.raises(ValueError, match=r"expected a folder.*, found nothing"):
        import_set(name, tmp_path / "none", tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="found none"):
        import_set(name, tmp_path / "empty", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_bad_arguments(tmp_path: Path):
    with pytest.raises(ValueError, match="set 'motion': expected one of op-align-real"):
        import_set("motion", tmp_path, tmp_path)
    with pytest.raises(ValueError, match="points: expected 1 or more, found 0"):
        import_set("hoi4d", tmp_path, tmp_path, points=0)


def test_names_of_categories():
    assert our_category("WashingMachine") == "washer"
    assert our_category("laptop_h") == "laptop"
    assert our_category("Trash Can") == "trash_can"
    assert our_category("..") == "models"


@pytest.fixture(scope="module")
def ovens(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set with one oven, twice."""
    folder = tmp_path_factory.mktemp("ovens")
    obj = generate("oven", "train", 3, 0)
    for name in ("0001", "0002"):
        foreign.shape2motion(obj, folder, "oven", name)
    return folder


@pytest.mark.parametrize("below", ["", "MDV02", "MDV02/oven", "MDV02/oven/0001", "MDV02/new"])
@pytest.mark.parametrize(
    "where",
    ["", pytest.param("MDV02", marks=pytest.mark.slow), "MDV02/oven",
     pytest.param("MDV02/oven/0001", marks=pytest.mark.slow)],
)  # fmt: skip
def test_no_original_is_touched(where: str, below: str, ovens: Path, tmp_path: Path):
    source = shutil.copytree(ovens, tmp_path / "set")
    top = source / "MDV02/oven"
    before = {path: path.read_bytes() for path in source.rglob("*") if path.is_file()}
    path, out = source / where, source / below
    try:
        made = import_set("shape2motion", path, out)
    except ValueError as error:
        assert "outside the source" in str(error)  # noqa: PT017 - some places are free
        made = Imported()
    assert {path: path.read_bytes() for path in before} == before
    top = path if path.name == "0001" else top
    within = path in (out, *out.parents)
    inside = within or top in (out / "oven/0001", *(out / "oven/0001").parents)
    assert bool(made.written) != inside


def test_a_link_into_the_source_is_no_way_around(tmp_path: Path):
    obj = generate("oven", "train", 3, 0)
    foreign.shape2motion(obj, tmp_path / "set", "oven")
    (tmp_path / "out").mkdir()
    (tmp_path / "out/oven").symlink_to(next((tmp_path / "set").rglob("oven")))
    before = {path: path.read_bytes() for path in (tmp_path / "set").rglob("*") if path.is_file()}
    made = import_set("shape2motion", tmp_path / "set", tmp_path / "out")
    assert not made.written
    assert "outside the source" in next(iter(made.refused.values()))
    assert {path: path.read_bytes() for path in before} == before


def test_a_foreign_folder_at_the_target_stays(tmp_path: Path):
    obj = generate("oven", "train", 3, 0)
    foreign.shape2motion(obj, tmp_path / "set", "oven")
    (tmp_path / "out/oven/0001").mkdir(parents=True)
    (tmp_path / "out/oven/0001/thesis.tex").write_text("years")
    made = import_set("shape2motion", tmp_path / "set", tmp_path / "out")
    assert not made.written
    assert "left alone" in next(iter(made.refused.values()))
    assert [path.name for path in (tmp_path / "out/oven/0001").iterdir()] == ["thesis.tex"]
