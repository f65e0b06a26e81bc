# SPDX-License-Identifier: MIT
"""Objects of boxes of which anybody can say what looks alike, from one side and from all sides."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from scapo.categories import category
from scapo.geometry.camera import Intrinsics
from sim_assets.generation.assets import procedural_assets
from sim_assets.objects import ArticulatedObject, Visual
from sim_assets.sampling.ambiguity import Alike, Ambiguity
from sim_assets.sampling.evidence import Tolerance
from sim_assets.sampling.turned_fit import TURNS
from sim_assets.sampling.viewpoints import look_along
from tests.helpers.boxes import box, origin

CAMERA = Intrinsics.from_fov(np.radians(60), 256, 256)
ABOUT_X = np.diag([1.0, -1.0, -1.0])
ABOUT_Z = np.diag([-1.0, -1.0, 1.0])
HANDLE = box((0.03, 0.16, 0.02), (-0.275, 0, 0.12))
"""On the upper half of the front of `chest`."""


def chest(*details: Visual, front: tuple[float, float] = (0.5, 0.4)) -> ArticulatedObject:
    """A box with a drawer whose front is in the middle of its face; `details` move with it."""
    width, height = front
    body = box((0.45, 0.6, 0.5), (0.0, 0, 0))
    drawer = box((0.4, width, height), (-0.06, 0, 0))
    return ArticulatedObject(
        category=category("drawer"),
        instance="chest",
        visuals=((body,), (drawer, *details)),
        pivot=np.zeros((1, 3)),
        axis=np.array([[-1.0, 0.0, 0.0]]),
        upper=np.array([0.3]),
        origin=origin("chest"),
    )


def flaps() -> ArticulatedObject:
    """A slab with two handles that fold outwards; half a turn about z exchanges them."""
    slab = box((0.3, 0.4, 0.1), (0, 0, 0))
    left, right = (box((0.02, 0.3, 0.2), (x, 0, 0.15)) for x in (-0.14, 0.14))
    return ArticulatedObject(
        category=category("basket"),
        instance="flaps",
        visuals=((slab,), (left,), (right,)),
        pivot=np.array([[-0.14, 0, 0.05], [0.14, 0, 0.05]]),
        axis=np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]),
        upper=np.radians([80.0, 80.0]),
        origin=origin("flaps"),
    )


def camera_at(*place: float, roll: float = 0.4) -> np.ndarray:
    """camera_T_object of a camera at this place in the object frame that looks at the origin."""
    eye = np.array(place)
    pose = np.eye(4)
    pose[:3, :3] = look_along(-eye / np.linalg.norm(eye), roll)
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


SQUARE_ON = camera_at(-1.5, 0, 0)
FROM_ABOVE = camera_at(-1.2, 0.6, 0.7)


def turns(alike: Alike) -> list[int]:
    return np.flatnonzero(alike.turns).tolist()


def number(turn: np.ndarray) -> int:
    return int(np.abs(TURNS - turn).sum((1, 2)).argmin())


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    cosine = (np.trace(a[:3, :3] @ b[:3, :3].T) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def test_the_turns_are_the_group_of_the_cube():
    assert np.allclose(TURNS[0], np.eye(3))
    assert np.allclose(np.linalg.det(TURNS), 1)
    assert len({tuple(turn.ravel()) for turn in TURNS}) == 24
    products = (TURNS[:, None] @ TURNS[None]).reshape(-1, 9)
    assert {tuple(p) for p in products} == {tuple(turn.ravel()) for turn in TURNS}


@pytest.mark.parametrize("eye", [SQUARE_ON, FROM_ABOVE], ids=["square on", "from above"])
def test_a_plain_front_looks_alike_upside_down(eye: np.ndarray):
    found = Ambiguity(chest(), CAMERA).find(np.array([0.15]), eye)
    half = number(ABOUT_X)
    assert turns(found) == sorted([0, half])
    expected = eye.copy()
    expected[:3, :3] = eye[:3, :3] @ ABOUT_X  # the box's centre is the origin
    assert degrees(found.camera_T_base[half], expected) < 0.2
    assert np.allclose(found.camera_T_base[half][:3, 3], eye[:3, 3], atol=2e-3)
    assert found.state[half] == pytest.approx(0.15, abs=2e-3)
    assert found.part[half].tolist() == [0, 1]


@pytest.mark.parametrize("eye", [SQUARE_ON, FROM_ABOVE], ids=["square on", "from above"])
def test_a_handle_above_the_middle_says_which_side_is_up(eye: np.ndarray):
    found = Ambiguity(chest(HANDLE), CAMERA).find(np.array([0.15]), eye)
    assert turns(found) == [0]
    assert found.unexplained[number(ABOUT_X)] > Tolerance().share


def test_what_is_hidden_says_nothing():
    inside = box((0.03, 0.16, 0.02), (0.2, 0, 0.24))  # in the body, behind the drawer
    thing = chest(inside)
    seen = Ambiguity(thing, CAMERA).find(np.array([0.15]), SQUARE_ON)
    assert turns(seen) == sorted([0, number(ABOUT_X)])
    ledge = box((0.02, 0.16, 0.02), (0.24, 0, 0.1))
    behind = ArticulatedObject(
        category=thing.category, instance="ledge", visuals=((*chest().visuals[0], ledge),
        chest().visuals[1]), pivot=thing.pivot, axis=thing.axis, upper=thing.upper,
        origin=thing.origin,
    )  # fmt: skip
    seen = Ambiguity(behind, CAMERA).find(np.array([0.15]), SQUARE_ON)
    assert turns(seen) == sorted([0, number(ABOUT_X)])
    whole = Ambiguity(behind, CAMERA, protocol="full").find(np.array([0.15]), SQUARE_ON)
    assert turns(whole) == [0]


def test_sides_that_differ_by_less_than_the_tolerance_look_alike():
    def quarter_turns(width: float) -> list[int]:
        body, drawer = box((0.45, width, 0.5), (0, 0, 0)), box((0.4, 0.4, 0.4), (-0.06, 0, 0))
        thing = chest()
        thing = ArticulatedObject(
            category=thing.category, instance="square", visuals=((body,), (drawer,)),
            pivot=thing.pivot, axis=thing.axis, upper=thing.upper, origin=thing.origin,
        )  # fmt: skip
        return turns(Ambiguity(thing, CAMERA).find(np.array([0.15]), SQUARE_ON))

    about_x = [k for k, turn in enumerate(TURNS) if np.allclose(turn[0], [1, 0, 0])]
    assert len(about_x) == 4
    assert quarter_turns(0.5) == about_x
    assert quarter_turns(0.503) == about_x
    assert quarter_turns(0.56) == sorted([0, number(ABOUT_X)])


@pytest.mark.parametrize("protocol", ["joint", "full"])
def test_states_and_parts_are_exchanged_where_that_is_what_looks_alike(protocol):
    state = np.radians([60.0, 25.0])
    found = Ambiguity(flaps(), CAMERA, protocol=protocol).find(state, FROM_ABOVE)
    half = number(ABOUT_Z)
    assert turns(found) == sorted([0, half])
    assert np.degrees(found.state[half]) == pytest.approx([25.0, 60.0], abs=1.0)
    assert found.part[half].tolist() == [0, 2, 1]
    assert found.part[0].tolist() == [0, 1, 2]


def test_a_whole_surface_shows_the_symmetry_of_the_object():
    """Square fronts: the four turns about x; a handle leaves one, wherever the camera is."""
    square = chest(front=(0.4, 0.4))
    body = box((0.45, 0.5, 0.5), (0, 0, 0))
    thing = ArticulatedObject(
        category=square.category, instance="square", visuals=((body,), square.visuals[1]),
        pivot=square.pivot, axis=square.axis, upper=square.upper, origin=square.origin,
    )  # fmt: skip
    found = Ambiguity(thing, CAMERA, protocol="full").find(np.array([0.15]), FROM_ABOVE)
    about_x = [k for k, turn in enumerate(TURNS) if np.allclose(turn[0], [1, 0, 0])]
    assert turns(found) == about_x
    handled = Ambiguity(chest(HANDLE), CAMERA, protocol="full")
    assert turns(handled.find(np.array([0.15]), FROM_ABOVE)) == [0]


def test_noise_hides_what_it_is_larger_than():
    """A handle 12 mm deep at 3 m: the disparity sensor's deviation is 8.5 mm there."""
    thin = box((0.012, 0.16, 0.02), (-0.266, 0, 0.12))
    far = camera_at(-3.0, 0, 0)
    thing = chest(thin)
    half = number(ABOUT_X)
    assert turns(Ambiguity(thing, CAMERA).find(np.array([0.15]), far)) == [0]
    noisy = Ambiguity(thing, CAMERA, "disparity").find(np.array([0.15]), far)
    assert turns(noisy) == sorted([0, half])


def test_an_oven_from_its_front_is_what_it_is():
    oven = procedural_assets("oven", "test", 1, 1)[0].load()
    found = Ambiguity(oven, CAMERA).find(0.6 * oven.upper, camera_at(-1.9, 0.8, 1.1))
    assert turns(found) == [0]
    assert found.camera_T_base.shape == (24, 4, 4)


def test_an_image_that_ends_before_the_object_says_less():
    """With the handle beyond the image's upper edge nothing tells up from down."""
    camera = Intrinsics(fx=220, fy=220, cx=128, cy=28, width=256, height=30)
    level = camera_at(-1.5, 0, 0, roll=0.0)
    thing = chest(HANDLE)
    assert turns(Ambiguity(thing, CAMERA).find(np.array([0.15]), level)) == [0]
    strip = Intrinsics(fx=220, fy=220, cx=128, cy=10, width=256, height=20)
    found = Ambiguity(thing, strip).find(np.array([0.15]), level)
    assert number(ABOUT_X) in turns(found)
    assert turns(Ambiguity(thing, camera).find(np.array([0.15]), level)) == [0]


def test_open_surfaces_are_seen_from_both_sides():
    """Single sheets instead of boxes, wound the wrong way round."""

    def sheet(visual: Visual) -> Visual:
        mesh = visual.mesh
        faces = mesh.faces[:-2, ::-1]  # open: two triangles are missing
        return Visual(mesh=trimesh.Trimesh(mesh.vertices, faces, process=False))

    thing = chest()
    thing = ArticulatedObject(
        category=thing.category, instance="sheets",
        visuals=tuple(tuple(sheet(v) for v in part) for part in thing.visuals),
        pivot=thing.pivot, axis=thing.axis, upper=thing.upper, origin=thing.origin,
    )  # fmt: skip
    found = Ambiguity(thing, CAMERA).find(np.array([0.15]), SQUARE_ON)
    assert turns(found) == sorted([0, number(ABOUT_X)])


def test_the_answer_does_not_depend_on_what_was_asked_before():
    finder = Ambiguity(chest(), CAMERA)
    first = finder.find(np.array([0.15]), FROM_ABOVE).row()
    finder.find(np.array([0.05]), SQUARE_ON)
    again = finder.find(np.array([0.15]), FROM_ABOVE).row()
    assert all((first[name] == again[name]).all() for name in first)


def test_parts_rendered_apart_are_refused():
    with pytest.raises(ValueError, match="expected protocol joint or full, found isolated"):
        Ambiguity(chest(), CAMERA, protocol="isolated")
