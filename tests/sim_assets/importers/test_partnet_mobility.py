# SPDX-License-Identifier: MIT
"""PartNet-Mobility models made plain are the same objects as before."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sim_assets.generation.build import write_object
from sim_assets.importers.sets import import_set
from sim_assets.models import reader
from sim_assets.objects import ArticulatedObject
from sim_assets.procedural import generate
from tests.helpers.foreign import assert_same


def partnet(obj: ArticulatedObject, folder: Path) -> None:
    """A URDF as PartNet-Mobility has it: an empty root link, semantics and meta files."""
    urdf = write_object(obj, folder)
    first = obj.category.parts[0].replace(" ", "_")
    text = urdf.read_text().replace(f'<robot name="{obj.instance}">', '<robot name="partnet_1">')
    root = (
        '<link name="base"/><joint name="joint_fixed" type="fixed"><parent link="base"/>'
        f'<child link="{first}"/><origin xyz="0 0 0" rpy="0 0 0"/></joint></robot>'
    )
    urdf.write_text(text.replace("</robot>", root))
    names = [part.replace(" ", "_") for part in obj.category.parts]
    rows = [f"{name} hinge some {name}\n" for name in names]
    (folder / "semantics.txt").write_text("".join(rows))
    (folder / "meta.json").write_text(json.dumps({"model_cat": "WashingMachine"}))


def test_partnet_mobility(tmp_path: Path):
    obj = generate("washer", "train", 3, 2)
    partnet(obj, tmp_path / "set" / "7120")
    made = import_set("partnet-mobility", tmp_path / "set", tmp_path / "out")
    urdf = tmp_path / "out" / "washer" / "7120" / "mobility.urdf"
    assert made.written == [urdf]
    assert made.refused == {}
    found = reader.read(urdf, "washer", root=tmp_path / "out")
    assert_same(found, obj)
    np.testing.assert_allclose(found.upper, obj.upper, atol=1e-6)
    assert [path.name for path in urdf.parent.iterdir()] != []
    assert not list(urdf.parent.rglob("*.txt"))


TWO_COLOURS = """mtllib two.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
usemtl red
f 1 4 3 2
f 1 2 6 5
f 2 3 7 6
usemtl blue
f 3 4 8 7
f 4 1 5 8
f 5 6 7 8
"""
"""A closed cube of side 1, three of its sides of another material."""
CUBES = """<robot name="partnet_2">
<link name="base"/>
<link name="link_0"><visual><geometry><mesh filename="two.obj"/></geometry></visual></link>
<link name="link_1"><visual><origin xyz="-1 0 0"/><geometry><mesh filename="two.obj"/></geometry>
</visual><visual><geometry><mesh filename="panel.obj"/></geometry></visual></link>
<joint name="fixed" type="fixed"><parent link="base"/><child link="link_0"/></joint>
<joint name="hinge" type="revolute"><parent link="link_0"/><child link="link_1"/>
<axis xyz="0 0 1"/><limit lower="0" upper="1.5" effort="1" velocity="1"/></joint>
</robot>"""


def test_a_closed_body_of_several_colours_stays_closed(tmp_path: Path):
    source = tmp_path / "set" / "7"
    source.mkdir(parents=True)
    (source / "two.obj").write_text(TWO_COLOURS)
    (source / "two.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n")
    (source / "panel.obj").write_text("v -1 0 0\nv -1 2 0\nv -1 0 2\nf 1 2 3\n")
    (source / "mobility.urdf").write_text(CUBES)
    (source / "meta.json").write_text(json.dumps({"model_cat": "Oven"}))
    (urdf,) = import_set("partnet-mobility", tmp_path / "set", tmp_path / "out").written
    before = reader.read(source / "mobility.urdf", "oven", root=source)
    after = reader.read(urdf, "oven", root=urdf.parent)
    ratio = np.cbrt(np.linalg.det(before.origin.object_T_asset[:3, :3]))
    for part, area in enumerate((6.0, 6.0 + 2 * 2.0)):  # a panel has two sides
        assert before.part_mesh(part).area == pytest.approx(area * ratio**2, rel=1e-6)
        assert after.part_mesh(part).area == pytest.approx(area * ratio**2, rel=1e-6)
        assert after.part_mesh(part).volume == pytest.approx(ratio**3, rel=1e-6)
        colours = [{visual.color for visual in obj.visuals[part]} for obj in (before, after)]
        assert colours[0] == colours[1]


PARTNET = {
    "oven": ("oven/101940", "oven"),
    "eyeglasses": ("eyeglasses/101284", "eyeglasses"),
    "drawer": ("storage/45213", "storage_furniture"),
    "scissors": ("scissors/10495", "scissors"),
}


@pytest.mark.parametrize("name", PARTNET)
def test_real_partnet_models_are_the_same_before_and_after(
    name: str, shared_dir: Path, tmp_path: Path
):
    folder, category = PARTNET[name]
    source = shared_dir / "assets" / folder
    made = import_set("partnet-mobility", source, tmp_path)
    assert made.refused == {}
    (urdf,) = made.written
    assert urdf.parent.parent.name in (category, folder.split("/")[0])
    before = reader.read(source / "mobility.urdf", name)
    after = reader.read(urdf, name)
    for part in range(len(before.visuals)):
        assert after.part_mesh(part).area == pytest.approx(before.part_mesh(part).area, rel=1e-4)
        np.testing.assert_allclose(
            after.part_mesh(part).bounds, before.part_mesh(part).bounds, atol=1e-5
        )
    np.testing.assert_allclose(after.pivot, before.pivot, atol=1e-5)
    np.testing.assert_allclose(after.axis, before.axis, atol=1e-5)
    np.testing.assert_allclose(after.upper, before.upper, atol=1e-5)
