# SPDX-License-Identifier: MIT
"""Object frame, rest and part order of each kind of category, on small models made for it."""

from __future__ import annotations

from itertools import permutations
from math import pi
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scapo.categories import Category, JointKind, JointSpec, Window, category
from sim_assets.models import frames, reader
from sim_assets.models import joints as rest
from sim_assets.models.joints import words
from sim_assets.models.validate import AssetError
from sim_assets.objects import ArticulatedObject
from tests.helpers.urdfs import box, cabinet, joint, write


def blades() -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Two halves of scissors about the pivot, tips at +x; the second is the first turned over."""
    blade = box((0.1, 0.008, 0.002), (0.05, 0.0, 0.001))
    arm = box((0.08, 0.008, 0.002), (-0.04, 0.008, 0.001))
    ring = trimesh.creation.annulus(0.012, 0.02, 0.002).apply_translation((-0.09, 0.022, 0.001))
    pieces = [blade, arm, ring]
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    faces = [piece.faces + start for piece, start in zip(pieces, starts, strict=False)]
    vertices = np.concatenate([piece.vertices for piece in pieces])
    turned = vertices * [1.0, -1.0, -1.0]
    halves = [trimesh.Trimesh(v, np.concatenate(faces), process=False) for v in (vertices, turned)]
    return halves[0], halves[1]


@pytest.mark.parametrize("turned", [0.0, 0.4, -0.3])
@pytest.mark.parametrize("swap", [False, True])
def test_scissors(turned: float, swap: bool, tmp_path: Path):
    """Closed along x, tips at +x, whichever half the URDF begins with and however open it is."""
    first, second = blades()
    links = {"left": second, "right": first} if swap else {"left": first, "right": second}
    sign = -1 if swap else 1
    limit = f"{-turned} {1 - turned}"
    origin = f'rpy="0 0 {sign * turned}"'
    joints = joint("screw", ("left", "right"), origin, f"0 0 {sign}", limit)
    thing = reader.read(write(tmp_path, links, joints), "scissors")
    assert thing.origin.rest["screw"] == pytest.approx(-turned, abs=1e-3)
    np.testing.assert_allclose(thing.axis, [[0, 0, -1]], atol=1e-9)
    # The first blade is the one from which the other opens about -z: here the lower one.
    assert thing.part_mesh(0).bounds[:, 2].mean() < 0
    np.testing.assert_allclose(thing.pivot[0, 1:], 0, atol=1e-3)
    assert thing.part_mesh(0).vertices[:, 0].max() - thing.pivot[0, 0] == pytest.approx(
        0.1, abs=1e-3
    )
    turn = np.diag([1.0, -1.0, -1.0])
    mirrored = thing.part_mesh(0).vertices @ turn
    np.testing.assert_allclose(
        np.sort(mirrored.round(4), 0), np.sort(thing.part_mesh(1).vertices.round(4), 0), atol=2e-3
    )


def glasses(folder: Path, *, zero: float, front: float) -> Path:
    """Temples drawn folded by `zero` at q = 0, the lenses towards x * front."""
    links = {"lenses": box((0.005, 0.14, 0.04), (0, 0, 0))}
    joints = ""
    for name, side in (("one", 1), ("two", -1)):
        links[name] = box((0.14, 0.004, 0.01), (-0.07 * front, 0, 0))
        turn = side * front * zero
        origin = f'xyz="{-0.005 * front} {0.068 * side} 0" rpy="0 0 {turn}"'
        axis = f"0 0 {side * front}"
        limit = f"{-zero} {1.4 - zero}"
        joints += joint(f"{name}_hinge", ("lenses", name), origin, axis, limit)
    return write(folder, links, joints)


@pytest.mark.parametrize("zero", [0.0, 0.7, 1.4])
@pytest.mark.parametrize("front", [1.0, -1.0])
def test_eyeglasses(zero: float, front: float, tmp_path: Path):
    thing = reader.read(glasses(tmp_path, zero=zero, front=front), "eyeglasses")
    assert all(q == pytest.approx(-zero, abs=1e-6) for q in thing.origin.rest.values())
    np.testing.assert_allclose(thing.extents(), [0.145 + 0.0025, 0.14, 0.04], atol=2e-3)
    middles = [thing.part_mesh(part).bounds.mean(0) for part in range(3)]
    assert middles[0][0] < middles[1][0], "the lenses are at the front, -x"
    assert middles[1][1] < 0 < middles[2][1], "the wearer's left is at -y"
    folded = thing.pose(thing.upper)
    for part in (1, 2):
        vertices = thing.part_mesh(part).vertices
        tips = vertices[vertices[:, 0] > vertices[:, 0].max() - 0.01]
        ends = tips @ folded[part][:3, :3].T + folded[part][:3, 3]
        assert ends[:, 0].max() < tips[:, 0].min(), "folded towards the lenses"
    np.testing.assert_allclose(np.abs(thing.axis[:, 2]), 1)


@pytest.mark.parametrize(
    ("axis", "limit", "sign"), [("0 1 0", "0 0.3", 1.0), ("0 -1 0", "-0.3 0", -1.0)]
)
def test_drawer(axis: str, limit: str, sign: float, tmp_path: Path):
    """The front is where the drawer goes; the pivot is the middle of its box."""
    links = {"body": box((0.4, 0.4, 0.5), (0, 0, 0)), "tray": box((0.3, 0.38, 0.1), (0, 0.02, 0))}
    joints = joint("slide", ("body", "tray"), 'xyz="0 0 0.1"', axis, limit)
    thing = reader.read(write(tmp_path, links, joints), "drawer")
    np.testing.assert_allclose(thing.axis, [[-1, 0, 0]], atol=1e-12)
    assert thing.origin.sign == (sign,)
    assert thing.origin.repairs == ("The front was told from the joint: y",)
    np.testing.assert_allclose(thing.upper, [0.3])
    np.testing.assert_allclose(thing.pivot[0], thing.part_mesh(1).bounds.mean(0), atol=1e-12)


def furniture(kind: JointKind, word: str, *travel: float) -> Category:
    """A category of one's own: a body with so many doors or drawers."""
    return Category(
        name="furniture",
        parts=("body", *(f"{word} {j}" for j in range(len(travel)))),
        joints=tuple(
            JointSpec(kind=kind, parent=0, child=j + 1, lower=0.0, upper=upper)
            for j, upper in enumerate(travel)
        ),
        window=Window(azimuth=(-60, 60), elevation=(0, 55)),
        diagonal=1.2,
        words=(word,),
    )


@pytest.mark.parametrize("first", [1, -1])
@pytest.mark.parametrize("quarters", range(4))
def test_two_doors_open_at_the_front(quarters: int, first: int, tmp_path: Path):
    """Hinged at the outer edges, so that their middles lie beside the hinges, not before them.

    The left one has the first joint's travel, be it the larger or the smaller.
    """
    turn = quarters * pi / 2
    links = {"body": box((0.4, 0.8, 0.9), (0, 0, 0))}
    joints = ""
    for name, side, height in (("one", first, 0.9), ("two", -first, 0.8)):
        links[f"{name}_door"] = box((0.02, 0.4, height), (-0.01, -0.2 * side, 0))
        x, y = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ (
            -0.2,
            0.4 * side,
        )
        limit = "-1.9 0" if side > 0 else "0 1.9"
        origin = f'xyz="{x} {y} 0" rpy="0 0 {turn}"'
        joints += joint(f"{name}_hinge", ("body", f"{name}_door"), origin, "0 0 1", limit)
    links["body"].apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
    thing = reader.read(write(tmp_path, links, joints), furniture("revolute", "door", 1.4, 0.7))
    np.testing.assert_allclose(thing.upper, [1.4, 0.7])
    closed = [thing.part_mesh(part).bounds for part in range(3)]
    assert all(door[0][0] < closed[0][0][0] for door in closed[1:]), "they close it at -x"
    assert closed[1].mean(0)[1] < closed[2].mean(0)[1]
    opened = thing.pose(np.array([0.3, 0.3]))
    for part in (1, 2):
        middle = closed[part].mean(0)
        assert (opened[part][:3, :3] @ middle + opened[part][:3, 3])[0] < middle[0] - 0.03


@pytest.mark.parametrize("widths", list(permutations((0.5, 0.6, 0.7))))
def test_drawers_are_numbered_from_the_top_down(widths: tuple[float, ...], tmp_path: Path):
    """Whichever is the largest; each with the travel of its number."""
    links, joints = {"body": box((0.5, 0.8, 1.0), (0, 0, 0))}, ""
    for k, width in enumerate(widths):
        links[f"drawer_{k}"] = box((0.4, width, 0.25), (-0.06, 0.01 * width, 0))
        ends, origin = ("body", f"drawer_{k}"), f'xyz="0 0 {0.3 * (k - 1)}"'
        joints += joint(f"slide_{k}", ends, origin, "-1 0 0", "0 0.35")
    kind = furniture("prismatic", "drawer", 0.1, 0.2, 0.3)
    thing = reader.read(write(tmp_path, links, joints), kind)
    assert thing.origin.joint_names == ("slide_2", "slide_1", "slide_0")
    np.testing.assert_allclose(thing.pivot[:, 2], [0.3, 0.0, -0.3], atol=1e-6)
    np.testing.assert_allclose(thing.upper, [0.1, 0.2, 0.3])
    middles = [thing.part_mesh(part).bounds.mean(0)[2] for part in (1, 2, 3)]
    np.testing.assert_allclose(middles, [0.3, 0.0, -0.3], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "axis", "up", "told"),
    [
        ("safe", "0 1 0", None, "y"),  # a fridge as glTF has it
        ("safe", "0 0.02 1", None, "z"),
        ("safe", "1 0 0", None, "z"),  # neither way
        ("safe", "0 1 0", "-y", "-y"),
        ("oven", "0 1 0", None, "z"),  # of any other category nothing is told
    ],
)
def test_what_is_up_is_told_where_a_safes_hinge_would_lie(
    name: str, axis: str, up: str | None, told: str, tmp_path: Path
):
    """A safe's hinge stands; what the caller says goes before."""
    links = {"body": box((0.4, 0.6, 0.5), (0, 0, 0)), "door": box((0.3, 0.3, 0.3), (0.2, 0.1, 0.1))}
    joints = joint("hinge", ("body", "door"), 'xyz="0.2 0 0"', axis, "0 1.5")
    origin = reader.read(write(tmp_path, links, joints), name, up=up).origin
    ratio = np.cbrt(np.linalg.det(origin.object_T_asset[:3, :3]))
    upward = origin.object_T_asset[2, :3] / ratio
    np.testing.assert_allclose(upward, frames.direction(told, tmp_path), atol=1e-9)
    said = f"What is up was told from the joint: {told}" in origin.repairs
    assert said == (up is None and told != "z")


def test_drawer_of_no_metric_size(tmp_path: Path):
    """The travel is scaled with the model, and no longer than the category's."""
    links = {"body": box((40, 40, 50), (0, 0, 0)), "tray": box((30, 38, 10), (-2, 0, 0))}
    joints = joint("slide", ("body", "tray"), 'xyz="0 0 0"', "-1 0 0", "0 30")
    path = write(tmp_path, links, joints)
    thing = reader.read(path, "drawer")
    ratio = 0.8 / np.linalg.norm((40, 40, 50))
    np.testing.assert_allclose(thing.upper, [30 * ratio])
    assert reader.read(path, "drawer", scale=0.1).upper[0] == category("drawer").joints[0].upper


@pytest.mark.parametrize("zero", [0.0, 1.2])
@pytest.mark.parametrize("side", [1, -1])
def test_laptop(zero: float, side: int, tmp_path: Path):
    """The user sits opposite to the hinge, at -x, and the lid opens about +y."""
    links = {
        "keys": box((0.2, 0.3, 0.02), (0, 0, 0)),
        "lid": box((0.2, 0.3, 0.01), (-0.1 * side, 0, 0.005)),
    }
    origin = f'xyz="{0.1 * side} 0 0.01" rpy="0 {side * zero} 0"'
    joints = joint("hinge", ("keys", "lid"), origin, f"0 {side} 0", f"{-zero} {2 - zero}")
    thing = reader.read(write(tmp_path, links, joints), "laptop")
    assert thing.origin.rest["hinge"] == pytest.approx(-zero)
    np.testing.assert_allclose(thing.axis, [[0, 1, 0]], atol=1e-9)
    np.testing.assert_allclose(thing.pivot[0, 0], 0.1, atol=1e-9)
    assert thing.part_mesh(1).bounds.mean(0)[2] > thing.part_mesh(0).bounds.mean(0)[2]


def basket(folder: Path, *, zero: float, along: str) -> Path:
    """Two handles drawn turned down by `zero`, hinges along x or y."""
    size = (0.3, 0.2) if along == "x" else (0.2, 0.3)
    links = {"body": box((*size, 0.2), (0, 0, 0))}
    joints = ""
    for name, side in (("one", 1), ("two", -1)):
        across = 0.05 * side
        links[name] = box((0.25, 0.01, 0.15) if along == "x" else (0.01, 0.25, 0.15), (0, 0, 0.075))
        place = (0, across) if along == "x" else (across, 0)
        axis = (-side, 0, 0) if along == "x" else (0, side, 0)
        turn = np.array(axis) * zero
        origin = f'xyz="{place[0]} {place[1]} 0.1" rpy="{turn[0]} {turn[1]} 0"'
        text = f"{axis[0]} {axis[1]} 0"
        joints += joint(f"{name}_hinge", ("body", name), origin, text, f"{-zero} {1.4 - zero}")
    return write(folder, links, joints)


@pytest.mark.parametrize("zero", [0.0, 0.6])
@pytest.mark.parametrize("along", ["x", "y"])
def test_basket(zero: float, along: str, tmp_path: Path):
    thing = reader.read(basket(tmp_path, zero=zero, along=along), "basket")
    assert all(q == pytest.approx(-zero, abs=1e-6) for q in thing.origin.rest.values())
    np.testing.assert_allclose(np.abs(thing.axis[:, 0]), 1, atol=1e-9)
    middles = [thing.part_mesh(part).bounds.mean(0) for part in range(3)]
    assert middles[1][1] > middles[2][1], "left of one who looks at the front"
    down = thing.pose(thing.upper)
    for part, side in ((1, 1), (2, -1)):
        vertices = thing.part_mesh(part).vertices
        laid = vertices @ down[part][:3, :3].T + down[part][:3, 3]
        assert laid[:, 2].max() < vertices[:, 2].max()
        assert side * laid[:, 1].mean() > side * vertices[:, 1].mean(), "each to its own side"


def test_mimics_are_followed_at_rest(tmp_path: Path):
    """A second door geared to the first is drawn where the first one's rest puts it."""
    links = {
        "body": box((0.3, 0.6, 0.6), (0, 0, 0)),
        "big": box((0.02, 0.35, 0.6), (0, -0.175, 0)),
        "small": box((0.02, 0.25, 0.6), (0, 0.125, 0)),
    }
    axis = "0 0 -1"
    first = joint("a", ("body", "big"), f'xyz="-0.16 0.05 0" rpy="0 0 {-0.8}"', axis, "-0.8 0.8")
    second = joint("b", ("body", "small"), f'xyz="-0.16 0.05 0" rpy="0 0 {0.8}"', axis, "-2 2")
    second = second.replace("</joint>", '<mimic joint="a" multiplier="-1"/></joint>')
    thing = reader.read(write(tmp_path, links, first + second), "oven", up="z", front="-x")
    assert thing.origin.joint_names == ("a",)
    assert thing.origin.rest == pytest.approx({"a": -0.8, "b": 0.8})
    np.testing.assert_allclose(thing.extents(), (0.32, 0.6, 0.6), atol=1e-6)


def partnet(folder: Path, joints: str) -> Path:
    """A cabinet in PartNet-Mobility's layout: y up, front towards z, an empty root."""
    links = {"link_0": box((1, 1, 1), (0, 0, 0)), "link_1": box((0.8, 0.2, 0.9), (0, 0, 0))}
    root = (
        '<link name="base"/><joint name="root" type="fixed"><parent link="base"/>'
        f'<child link="link_0"/><origin rpy="{pi / 2} 0 {-pi / 2}"/></joint>'
    )
    path = write(folder, links, root + joints)
    (folder / "semantics.txt").write_text("link_0 heavy furniture_body\nlink_1 slider drawer\n")
    return path


@pytest.mark.parametrize("named", [True, False])
def test_partnet_frame_and_size(named: bool, tmp_path: Path):
    joints = joint("slide", ("link_0", "link_1"), 'xyz="0 0 0.05"', "0 0 1", "0 0.7")
    path = partnet(tmp_path, joints)
    if not named:
        (tmp_path / "semantics.txt").unlink()
    thing = reader.read(path, "drawer")
    np.testing.assert_allclose(thing.axis, [[-1, 0, 0]], atol=1e-12)
    diagonal = np.linalg.norm(thing.extents())
    assert diagonal == pytest.approx(thing.category.diagonal)
    np.testing.assert_allclose(thing.upper, 0.7 * diagonal / np.sqrt(3))
    assert thing.origin.repairs == ()


def test_partnet_drawer_at_another_side(tmp_path: Path):
    """The drawer faces -x even where the model's usual front does not have it."""
    joints = joint("slide", ("link_0", "link_1"), 'xyz="0.1 0 0"', "1 0 0", "0 0.7")
    thing = reader.read(partnet(tmp_path, joints), "drawer")
    np.testing.assert_allclose(thing.axis, [[-1, 0, 0]], atol=1e-12)
    assert thing.origin.repairs == ("The front was told from the joint: -y",)
    asked = reader.read(partnet(tmp_path / "b", joints), "drawer", front="-x")
    np.testing.assert_allclose(asked.axis, [[0, -1, 0]], atol=1e-12)


def test_geared_temples(tmp_path: Path):
    """A temple that mimics the other is a joint of its own where the category needs two."""
    path = glasses(tmp_path, zero=0.0, front=-1.0)
    text = path.read_text()
    k = text.rindex("</joint>")
    path.write_text(f'{text[:k]}<mimic joint="one_hinge"/>{text[k:]}')
    thing = reader.read(path, "eyeglasses")
    assert set(thing.origin.joint_names) == {"one_hinge", "two_hinge"}


@pytest.mark.parametrize(
    ("name", "vector"), [("x", (1, 0, 0)), ("+Y", (0, 1, 0)), (" -z ", (0, 0, -1))]
)
def test_direction(name: str, vector: tuple[float, ...], tmp_path: Path):
    np.testing.assert_array_equal(frames.direction(name, tmp_path), vector)


@pytest.mark.parametrize("name", ["", "w", "--x", "xy", "-", "x-"])
def test_no_direction(name: str, tmp_path: Path):
    with pytest.raises(AssetError, match="direction"):
        frames.direction(name, tmp_path)


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
@pytest.mark.parametrize("front", ["x", "-x", "y", "-y", "z", "-z"])
def test_basis_is_a_rotation(up: str, front: str, tmp_path: Path):
    if up[-1] == front[-1]:
        return
    upward, forward = frames.direction(up, tmp_path), frames.direction(front, tmp_path)
    rotation = frames.basis(upward, forward, tmp_path)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_array_equal(rotation @ upward, [0, 0, 1])
    np.testing.assert_array_equal(rotation @ forward, [-1, 0, 0])


def test_hull_area_of_flat_and_solid_sets():
    cube = trimesh.creation.box((1, 1, 1)).vertices
    assert rest.hull_area(np.asarray(cube)) == pytest.approx(6)
    flat = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [1, 0.5, 0]], float)
    assert rest.hull_area(flat) == pytest.approx(4)
    assert len(rest.hull_points(flat)) == 4


def test_a_round_part_is_thinned_for_the_search_of_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Every vertex of a sphere is a corner of its hull; 10,000 took a quarter second a hull."""
    ball = np.asarray(trimesh.creation.icosphere(subdivisions=5, radius=0.5).vertices)
    assert rest.hull_area(rest.outermost(ball)) == pytest.approx(np.pi, rel=0.01)
    sizes, area = [], rest.hull_area

    def spy(points: np.ndarray) -> float:
        sizes.append(len(points))
        return area(points)

    monkeypatch.setattr(rest, "hull_area", spy)
    door = ('<mesh filename="meshes/door.obj"/>', '<sphere radius="0.2"/>')
    thing = reader.read(cabinet(tmp_path, door), "safe")
    assert thing.origin.rest == {"hinge": 0.0}  # swings away from the body
    assert len(sizes) > 60
    assert max(sizes) < 1100


def test_words():
    assert words("doorHandle", "left_legs", "LinkABC") == {
        "door", "handle", "left", "leg", "link", "abc",
    }  # fmt: skip


def test_left_is_left_of_one_who_looks_out_of_the_front():
    """z up, looking along -x: left = up x forward = -y."""
    np.testing.assert_array_equal(np.cross([0, 0, 1], [-1, 0, 0]), [0, -1, 0])


def test_states_open(tmp_path: Path):
    thing: ArticulatedObject = reader.read(glasses(tmp_path, zero=0.0, front=-1.0), "eyeglasses")
    assert (thing.upper > 1.3).all()
    assert (thing.upper <= pi / 2).all()
