# SPDX-License-Identifier: MIT
"""The real models beside the repository: each is brought to the object frame, or refused."""

from __future__ import annotations

import csv
import warnings
from pathlib import Path

import numpy as np
import pytest
import yourdfpy

from sim_assets import procedural
from sim_assets.generation.build import write_object
from sim_assets.inspect.check import Options, check_one
from sim_assets.models import reader
from sim_assets.models.validate import AssetError
from sim_assets.objects import ArticulatedObject

AS = {
    "oven": "oven",
    "dishwasher": "oven",
    "microwave": "safe",
    "fridge": "safe",
    "eyeglasses": "eyeglasses",
    "laptop": "laptop",
    "storage": "drawer",
    "scissors": "scissors",
    "box": "suitcase",
    "stapler": "laptop",
    "faucet": "washer",
    "cart": "washer",
}
"""Folder -> the category that its models are read as."""


@pytest.fixture(scope="module")
def models(shared_dir: Path) -> dict[str, tuple[Path, ArticulatedObject]]:
    """Folder/id -> file and object, of all models but the quirks and the bucket."""
    root = shared_dir / "assets"
    result = {}
    for urdf in reader.find(root):
        group = urdf.relative_to(root).parts[0]
        if group in AS:
            name = "/".join(urdf.relative_to(root).parts[:2])
            result[name] = (urdf, reader.read(urdf, AS[group], root=root))
    return result


Models = dict[str, tuple[Path, ArticulatedObject]]


def of(models: Models, *groups: str) -> list[ArticulatedObject]:
    found = [thing for name, (_, thing) in models.items() if name.split("/")[0] in groups]
    assert found
    return found


def test_every_model_is_there(models: Models, shared_dir: Path):
    with (shared_dir / "assets/index.csv").open() as file:
        listed = {f"{row['category']}/{row['id']}" for row in csv.DictReader(file)}
    assert {name for name in listed if name.split("/")[0] in AS} == set(models)


def test_frames_and_sizes(models: Models):
    for name, (_, thing) in models.items():
        boxes = np.concatenate([v.mesh.bounds for part in thing.visuals for v in part])
        np.testing.assert_allclose(boxes.min(0) + boxes.max(0), 0, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(np.linalg.norm(thing.axis, axis=1), 1)
        similarity = thing.origin.object_T_asset[:3, :3]
        scale = np.cbrt(np.linalg.det(similarity))
        np.testing.assert_allclose(similarity @ similarity.T, scale**2 * np.eye(3), atol=1e-9)
        uppers = [joint.upper for joint in thing.category.joints]
        assert (thing.upper > 0.1).all(), name
        assert (thing.upper <= uppers).all(), name
        if (Path(models[name][0]).parent / "semantics.txt").exists():
            diagonal = np.linalg.norm(thing.extents())
            assert diagonal == pytest.approx(thing.category.diagonal)


def test_states_move_as_the_urdf_does(models: Models):
    """pose(state) against yourdfpy at q = rest + sign * state, mapped to the object frame."""
    for name, (urdf, thing) in models.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            other = yourdfpy.URDF.load(str(urdf), load_meshes=False)
        scale = np.cbrt(np.linalg.det(thing.origin.object_T_asset[:3, :3]))
        state = 0.6 * thing.upper
        poses = thing.pose(state)
        for j, (joint, spec) in enumerate(
            zip(thing.origin.joint_names, thing.category.joints, strict=True)
        ):
            unit = scale if spec.kind == "prismatic" else 1.0
            at = dict(thing.origin.rest)
            ends = other.joint_map[joint]
            frames = []
            for q in (at[joint], at[joint] + thing.origin.sign[j] * state[j] / unit):
                other.update_cfg({**at, joint: q})
                frames.append(other.get_transform(ends.child, other.base_link))
            motion = frames[1] @ np.linalg.inv(frames[0])
            to_object = thing.origin.object_T_asset
            expected = to_object @ motion @ np.linalg.inv(to_object)
            found = poses[spec.child]
            if thing.category.name == "scissors" and not np.allclose(found, expected, atol=1e-6):
                found = np.linalg.inv(found)  # the URDF's base is the second blade
            np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=name)


def posed(thing: ArticulatedObject, part: int, share: float) -> np.ndarray:
    pose = thing.pose(thing.upper * share)[part]
    return thing.part_mesh(part).vertices @ pose[:3, :3].T + pose[:3, 3]


def test_closed_at_rest(models: Models):
    """The box of the whole is smaller at rest than open, larger for eyeglasses."""
    for name, (_, thing) in models.items():
        if thing.category.name == "washer":
            continue
        sizes = []
        for share in (0.0, 0.5, 1.0):
            points = np.concatenate(
                [posed(thing, part, share) for part in range(len(thing.visuals))]
            )
            sides = np.ptp(points, axis=0)
            sizes.append(sides @ np.roll(sides, 1))
        if thing.category.rest == "largest-box":
            sizes = [-size for size in sizes]
        assert sizes[0] < sizes[1] + 1e-9, name
        assert sizes[0] < sizes[2] + 1e-9, name


def test_doors_open_downwards_at_the_front(models: Models):
    for thing in of(models, "oven", "dishwasher"):
        np.testing.assert_allclose(thing.axis, [[0, -1, 0]], atol=1e-6)
        door = thing.part_mesh(1).bounds
        assert door[0, 0] == pytest.approx(-thing.extents()[0] / 2, abs=0.05)
        assert door[1, 0] < 0
        assert posed(thing, 1, 1.0)[:, 0].min() < door[0, 0] - 0.1


def test_doors_open_sideways_at_the_front(models: Models):
    for name in ("fridge/10849", "fridge/10905", "microwave/7310", "microwave/7167"):
        thing = models[name][1]
        np.testing.assert_allclose(np.abs(thing.axis[0, 2]), 1, atol=1e-6)
        assert posed(thing, 1, 0.5)[:, 0].min() < thing.part_mesh(1).bounds[0, 0] - 0.1


def test_drawers_slide_out_of_the_front(models: Models):
    for thing in of(models, "storage"):
        np.testing.assert_allclose(thing.axis, [[-1, 0, 0]], atol=1e-6)
        tray = thing.part_mesh(1).bounds
        assert tray[0, 0] > -thing.extents()[0] / 2 - 1e-9
        assert 0.4 * np.ptp(tray[:, 0]) < thing.upper[0] <= 0.45


def test_laptop(models: Models):
    thing = models["laptop/metaworld_laptop"][1]
    np.testing.assert_allclose(thing.axis, [[0, 1, 0]], atol=1e-6)
    assert thing.pivot[0, 0] > 0.1
    assert thing.extents()[2] < 0.06
    assert thing.origin.sign == (-1.0,), "it is open at zero"
    assert posed(thing, 1, 1.0)[:, 2].max() > 0.2


def test_eyeglasses(models: Models):
    for thing in of(models, "eyeglasses"):
        middles = [thing.part_mesh(part).bounds.mean(0) for part in range(3)]
        assert middles[0][0] < middles[1][0]
        assert middles[1][1] < -0.03 < 0.03 < middles[2][1]
        assert (np.abs(thing.axis[:, 2]) > 0.9).all()
        assert (thing.axis[0, 2] > 0) & (thing.axis[1, 2] < 0)
        assert thing.extents()[2] < thing.extents()[1]


def test_scissors(models: Models):
    thing = models["scissors/10495"][1]
    np.testing.assert_allclose(thing.axis, [[0, 0, -1]], atol=1e-6)
    length, width, height = thing.extents()
    assert length > 2.5 * width > 5 * height
    for part in (0, 1):
        tip = thing.part_mesh(part).vertices
        tip = tip[tip[:, 0].argmax()]
        assert abs(tip[1] - thing.pivot[0, 1]) < 0.01


@pytest.mark.parametrize(
    ("name", "status", "sentence"),
    [
        ("7320_missing_meshes", "refused", "new-5.obj"),
        ("12414_all_fixed", "refused", "mobility_v2.json lists hinge"),
        ("drawer_xml00", "repaired", "version '0.0'"),
        ("fridge_comma_scale", "repaired", "Commas between numbers"),
    ],
)
def test_quirks(name: str, status: str, sentence: str, shared_dir: Path):
    root = shared_dir / "assets/quirks"
    urdf = reader.find(root / name)[0]
    result = check_one(urdf, root, Options())
    assert result.status == status
    assert sentence in result.reason + " ".join(result.repairs)


def test_one_handle_is_no_basket(shared_dir: Path):
    root = shared_dir / "assets"
    with pytest.raises(AssetError, match="2 revolute joints"):
        reader.read(root / "bucket/100454/mobility.urdf", "basket", root=root)


def test_partnet_models_keep_their_frame(models: Models):
    """After the set's fixed joint z is up and the front faces -x: only the scale is ours."""
    for name, (urdf, thing) in models.items():
        plain = thing.category.name not in ("scissors", "washer")
        if (urdf.parent / "semantics.txt").exists() and plain:
            similarity = thing.origin.object_T_asset[:3, :3]
            scaled = similarity / np.cbrt(np.linalg.det(similarity))
            np.testing.assert_allclose(scaled, np.eye(3), atol=1e-9, err_msg=name)


def test_overrides(shared_dir: Path):
    """A fridge modelled with y up stands, for its doors' hinges do, and lies when told so."""
    urdf = shared_dir / "assets/fridge/habitat_fridge/fridge.urdf"
    lying = reader.read(urdf, "safe", up="z")
    standing = reader.read(urdf, "safe")
    assert "top_door_hinge" in standing.origin.joint_names
    assert standing.pivot[0, 2] > 0.3
    assert lying.extents()[2] < 0.8
    assert standing.extents()[2] > 1.9
    assert abs(standing.axis[0, 2]) > 0.99


@pytest.mark.parametrize("name", sorted(procedural.RECIPES))
def test_procedural_objects_are_read_back(name: str, tmp_path: Path):
    """The generator's object, written and read, is the same object in the same frame."""
    made = procedural.generate(name, "train", 3, 0)
    thing = reader.read(write_object(made, tmp_path / "one"), name, root=tmp_path)
    assert thing.origin.repairs == ()
    np.testing.assert_allclose(thing.origin.object_T_asset, np.eye(4), atol=1e-6)
    np.testing.assert_allclose(thing.pivot, made.pivot, atol=1e-6)
    np.testing.assert_allclose(thing.axis, made.axis, atol=1e-6)
    np.testing.assert_allclose(thing.upper, made.upper, atol=1e-6)
    assert thing.origin.joint_names == made.origin.joint_names
    for part in range(len(made.visuals)):
        theirs, ours = made.part_mesh(part), thing.part_mesh(part)
        assert len(ours.faces) == len(theirs.faces)
        np.testing.assert_allclose(ours.bounds, theirs.bounds, atol=1e-6)
        assert ours.area == pytest.approx(theirs.area, rel=1e-5)
