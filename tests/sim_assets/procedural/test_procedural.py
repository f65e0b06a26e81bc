# SPDX-License-Identifier: MIT
"""Every procedural category: closed, centred, metric, varied, reproducible, free of collisions."""

from __future__ import annotations

import dataclasses
from dataclasses import fields

import numpy as np
import pytest

from scapo.categories import CATEGORIES
from sim_assets.objects import ArticulatedObject
from sim_assets.procedural import (
    RECIPES,
    SPLITS,
    draw_shape,
    generate,
    recipe,
)
from sim_assets.procedural.assembly import assemble
from sim_assets.procedural.parameters import PROPORTIONS, Options, Span, agrees, draw
from tests.helpers.clearance import penetration, spread_states

# Bounding box at rest, metres: from what a household has to what a shop could sell.
SIZES = {
    "laptop": ((0.09, 0.18, 0.012), (0.56, 0.48, 0.09)),
    "safe": ((0.16, 0.16, 0.09), (1.5, 1.6, 2.1)),
    "oven": ((0.29, 0.33, 0.4), (1.6, 1.3, 2.1)),
    "washer": ((0.32, 0.33, 0.4), (1.3, 1.1, 2.6)),
    "eyeglasses": ((0.06, 0.09, 0.018), (0.28, 0.21, 0.11)),
    "basket": ((0.11, 0.2, 0.15), (0.8, 0.62, 1.25)),
    "drawer": ((0.14, 0.13, 0.1), (1.7, 1.4, 2.8)),
    "suitcase": ((0.13, 0.28, 0.05), (1.4, 1.15, 0.85)),
    "scissors": ((0.08, 0.04, 0.005), (0.42, 0.16, 0.035)),
}
categories = pytest.mark.parametrize("category", RECIPES)


def made(category: str) -> list[ArticulatedObject]:
    """Two instances of the training range, one beyond it, one rearranged."""
    return [generate(category, split, 1, i) for split in ("train", "test-ood") for i in (0, 1)]


def same(a: ArticulatedObject, b: ArticulatedObject) -> bool:
    pairs = [
        (x, y)
        for part_a, part_b in zip(a.visuals, b.visuals, strict=True)
        for x, y in zip(part_a, part_b, strict=True)
    ]
    return all(
        x.mesh.vertices.tobytes() == y.mesh.vertices.tobytes()
        and x.mesh.faces.tobytes() == y.mesh.faces.tobytes()
        and x.color == y.color
        for x, y in pairs
    ) and np.array_equal(a.upper, b.upper)


def test_every_category_has_a_recipe():
    assert set(RECIPES) == set(CATEGORIES)


@categories
def test_surfaces_are_closed_and_face_outwards(category: str):
    for obj in made(category):
        for part in obj.visuals:
            for visual in part:
                mesh = visual.mesh
                assert mesh.is_watertight
                assert mesh.is_winding_consistent
                assert mesh.area_faces.min() > 1e-13
                bodies = mesh.split(only_watertight=False)
                assert min(body.volume for body in bodies) > 0
                assert all(0 <= channel <= 1 for channel in visual.color)


@categories
def test_triangles_stay_few(category: str):
    for obj in made(category):
        assert sum(len(obj.part_mesh(p).faces) for p in range(len(obj.visuals))) < 20_000


@categories
def test_size_origin_and_joints(category: str):
    known = CATEGORIES[category]
    for obj in made(category):
        assert len(obj.visuals) == len(known.parts)
        points = np.concatenate([obj.part_mesh(p).vertices for p in range(len(known.parts))])
        np.testing.assert_allclose(points.max(0) + points.min(0), 0.0, atol=4e-7)
        low, high = SIZES[category]
        assert (obj.extents() >= low).all()
        assert (obj.extents() <= high).all()
        np.testing.assert_allclose(np.linalg.norm(obj.axis, axis=1), 1.0, atol=1e-9)
        for j, joint in enumerate(known.joints):
            assert 0.06 * joint.upper < obj.upper[j] <= joint.upper + 1e-6
        np.testing.assert_array_equal(obj.origin.object_T_asset, np.eye(4))


@categories
def test_a_state_above_zero_opens(category: str):
    """The moving part's middle goes forward, up, inwards or outwards, as the category opens."""
    obj = made(category)[0]
    poses = obj.pose(0.5 * obj.upper)
    moves = []
    for j, joint in enumerate(obj.category.joints):
        middle = obj.part_mesh(joint.child).bounds.mean(0)
        moves.append(poses[joint.child][:3, :3] @ middle + poses[joint.child][:3, 3] - middle)
        assert np.linalg.norm(moves[j]) > 0.004
    expected = {
        "laptop": [(2, 1)], "suitcase": [(2, 1)], "oven": [(0, -1)], "safe": [(0, -1)],
        "washer": [(0, -1)], "drawer": [(0, -1)], "scissors": [(1, 1)],
        "eyeglasses": [(1, 1), (1, -1)], "basket": [(1, 1), (1, -1)],
    }  # fmt: skip
    for move, (axis, sign) in zip(moves, expected[category], strict=True):
        if category != "scissors":  # its middle lies near the pivot
            assert move[axis] * sign > 0.004


def test_which_side_is_left():
    """Left temple at the wearer's left (-y, looking towards -x), left handle at +y from ahead."""
    glasses, basket = generate("eyeglasses", "train", 0, 0), generate("basket", "train", 0, 0)
    assert glasses.part_mesh(1).vertices[:, 1].max() < 0 < glasses.part_mesh(2).vertices[:, 1].min()
    assert basket.pivot[1, 1] < 0 < basket.pivot[0, 1]


def test_blades_and_doors():
    scissors = generate("scissors", "train", 0, 0)
    assert scissors.part_mesh(0).bounds[1, 0] > scissors.pivot[0, 0] + 0.04
    for category in ("safe", "washer"):
        obj = generate(category, "train", 0, 0)
        assert obj.pivot[0, 1] > obj.part_mesh(1).bounds.mean(0)[1]


def test_drawer_pivot_is_the_centre_of_the_drawer():
    obj = generate("drawer", "train", 0, 3)
    np.testing.assert_allclose(obj.pivot[0], obj.part_mesh(1).bounds.mean(0), atol=2e-7)


@categories
def test_parts_do_not_reach_into_one_another(category: str):
    for split, index in (("train", 0), ("test-ood", 0), ("test-ood", 1)):
        obj = generate(category, split, 2, index)
        steps = 7 if len(obj.upper) == 1 else 3
        assert penetration(obj, spread_states(obj, steps), count=600) == 0.0


@pytest.mark.slow
@categories
def test_parts_do_not_reach_into_one_another_on_many(category: str):
    chosen = [("train", index) for index in range(6)]
    chosen += [("test-ood", index) for index in range(12)]  # every trait
    for split, index in chosen:
        obj = generate(category, split, 3, index)
        steps = 7 if len(obj.upper) == 1 else 4
        assert penetration(obj, spread_states(obj, steps), count=1000) == 0.0


def test_a_collision_is_found():
    """A laptop whose lid turns the wrong way goes through its base."""
    obj = generate("laptop", "train", 0, 0)
    wrong = dataclasses.replace(obj, axis=-obj.axis)
    assert penetration(wrong, spread_states(wrong, 3)) > 3e-3


@categories
def test_equal_arguments_give_equal_objects(category: str):
    first, second = generate(category, "test", 5, 7), generate(category, "test", 5, 7)
    assert same(first, second)
    assert first.origin.sha256 == second.origin.sha256
    assert first.instance == second.instance == f"{category}-test-5-00007"


@categories
def test_splits_share_no_instance(category: str):
    digests = [generate(category, split, 0, i).origin.sha256 for split in SPLITS for i in range(3)]
    digests.append(generate(category, "train", 1, 0).origin.sha256)
    assert len(set(digests)) == len(digests)


@categories
def test_every_proportion_varies(category: str):
    first, second = (draw_shape(category, "train", 0, i) for i in (0, 1))
    names = [f.name for f in fields(first) if isinstance(f.metadata.get("draw"), Span)]
    assert len(names) >= 8
    assert all(getattr(first, name) != getattr(second, name) for name in names)


@categories
def test_details_come_and_go(category: str):
    shapes = [draw_shape(category, "train", 0, i) for i in range(60)]
    names = [f.name for f in fields(shapes[0]) if isinstance(f.metadata.get("draw"), Options)]
    varied = [name for name in names if len({getattr(s, name) for s in shapes}) > 1]
    booleans = [name for name in varied if isinstance(getattr(shapes[0], name), bool)]
    assert len(booleans) >= 3
    assert varied == names


@categories
def test_out_of_distribution_is_out_of_the_training_distribution(category: str):
    held_out = recipe(category).held_out
    for index in range(20):
        known = draw_shape(category, "train", 0, index)
        unseen = draw_shape(category, "test-ood", 0, 2 * index)
        assert not known.trait
        assert unseen.trait == PROPORTIONS
        as_dict = {f.name: getattr(unseen, f.name) for f in fields(unseen)}
        assert any(agrees(as_dict, combination) for combination in held_out)
        as_dict = {f.name: getattr(known, f.name) for f in fields(known)}
        assert not any(agrees(as_dict, combination) for combination in held_out)
        assert _outside(known) == 0
        assert _outside(unseen) >= 4


@categories
def test_rearranged_instances_are_drawn_as_for_training(category: str):
    """What sets them apart is their trait alone; traits come by turns."""
    held_out, traits = recipe(category).held_out, recipe(category).rearranged
    shapes = [draw_shape(category, "test-ood", 0, index) for index in range(1, 25, 2)]
    for shape in shapes:
        as_dict = {f.name: getattr(shape, f.name) for f in fields(shape)}
        assert not any(agrees(as_dict, combination) for combination in held_out)
        assert _outside(shape) == 0
    assert [shape.trait for shape in shapes] == [traits[k % len(traits)] for k in range(12)]


def _outside(shape: object) -> int:
    """How many proportions lie outside their training range; none may leave the outer range."""
    count = 0
    for entry in fields(shape):  # pyright: ignore[reportArgumentType]
        bounds = entry.metadata.get("draw")
        if isinstance(bounds, Span):
            value = getattr(shape, entry.name)
            assert bounds.least <= value <= bounds.most
            count += not bounds.low <= value <= bounds.high
    return count


def symmetric(category: str, seed: int) -> ArticulatedObject:
    """An instance that its category's swap symmetry maps onto itself, parts exchanged."""
    made = recipe(category)
    shape = draw(made.shape, np.random.default_rng(seed))
    design = made.build(dataclasses.replace(shape, **(made.symmetric or {})))
    return assemble(category, f"{category}-symmetric-{seed}", design, "symmetric", "0")


@pytest.mark.parametrize("category", [c.name for c in CATEGORIES.values() if c.symmetry])
def test_the_swap_symmetry_exchanges_the_parts(category: str):
    """A turns each moving part onto its counterpart and the joint onto itself."""
    obj = symmetric(category, seed=0)
    turn = np.array(obj.category.symmetry, float)
    one = len(obj.visuals) == 2
    pairs = [(0, 1)] if one else [(0, 0), (1, 2)]
    for a, b in pairs:
        turned = np.unique(np.round(obj.part_mesh(a).vertices @ turn.T, 6) + 0.0, axis=0)
        other = np.unique(np.round(obj.part_mesh(b).vertices, 6) + 0.0, axis=0)
        assert len(turned) == len(other)
        np.testing.assert_allclose(_sorted(turned), _sorted(other), atol=2.1e-6)
    j, k = (0, 0) if one else (0, 1)
    # two parts: the base seen from the moving part turns the other way
    sign = -1.0 if one else 1.0
    np.testing.assert_allclose(sign * turn @ obj.axis[j], obj.axis[k], atol=1e-9)
    between = turn @ obj.pivot[j] - obj.pivot[k]
    np.testing.assert_allclose(np.cross(between, obj.axis[k]), 0.0, atol=1e-6)
    np.testing.assert_allclose(obj.upper[j], obj.upper[k])


def _sorted(points: np.ndarray) -> np.ndarray:
    """Rows matched by a coarse key, so that last digits do not reorder them."""
    key = np.round(points, 4) + 0.0
    return points[np.lexsort((*(points.T[::-1]), *(key.T[::-1])))]


@pytest.mark.parametrize("category", ["laptop", "eyeglasses", "basket", "scissors", "suitcase"])
def test_the_swap_symmetry_holds_in_motion(category: str):
    """Where the parts are in relation to one another stays the same after the exchange."""
    obj = symmetric(category, seed=1)
    turn = np.eye(4)
    turn[:3, :3] = np.array(obj.category.symmetry)
    if len(obj.visuals) == 2:
        poses = obj.pose(np.array([0.4]))
        expected = turn @ np.linalg.inv(poses[1]) @ turn.T
        np.testing.assert_allclose(expected, poses[1], atol=1e-6)
    else:
        a, b = obj.pose(np.array([0.4, 0.2])), obj.pose(np.array([0.2, 0.4]))
        np.testing.assert_allclose(turn @ a[1] @ turn.T, b[2], atol=1e-6)
        np.testing.assert_allclose(turn @ a[2] @ turn.T, b[1], atol=1e-6)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="category 'chair': expected one of laptop"):
        generate("chair", "train", 0, 0)
    with pytest.raises(ValueError, match="split 'dev': expected one of train, val"):
        generate("laptop", "dev", 0, 0)
    with pytest.raises(ValueError, match="seed and index: expected numbers >= 0"):
        generate("laptop", "train", 0, -1)
