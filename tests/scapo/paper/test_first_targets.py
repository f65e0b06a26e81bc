# SPDX-License-Identifier: MIT
"""What the networks are told first carries the template onto each cloud as the search placed it."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from scapo.categories import CATEGORIES, JointKind
from scapo.first_weights import initialise
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.method import Journal
from scapo.paper.first_targets import Inputs, first_targets, fit_networks, lying
from scapo.paper.heads import JointNetwork, KeypointNetwork, ResidualNetwork
from scapo.paper.part_search import Placements, Skeleton, T, having, posed, values
from scapo.paper.skinning import Bones, cross_maps, deform, part_maps
from scapo.records import map_tensors
from tests.helpers.strategies import generator, normal
from tests.helpers.tiny import TINY


def skeleton(joints: int) -> Skeleton:
    """Blobs far apart, so that weights are one-hot."""
    middle = 2 * torch.eye(3).double()[: joints + 1]
    points = (middle[:, None] + 0.05 * normal(0, joints + 1, 20, 3)).flatten(0, 1)
    return Skeleton(
        points=points,
        keypoints=points.unflatten(0, (joints + 1, 20)).mean(1),
        factor=20 * torch.eye(3).double().expand(joints + 1, 3, 3),
        pivot=normal(1, joints, 3),
        axis=normal(2, joints, 3),
    )


def placements(joints: int, clouds: int = 5) -> Placements:
    return Placements(
        turn=0.4 * normal(3, clouds, 3),
        shift=0.1 * normal(4, clouds, 3),
        size=0.1 * normal(5, clouds, 3),
        aside=0.1 * normal(9, clouds, joints, 3),
        state=normal(6, clouds, joints),
    )


def single(of: T) -> T:
    """The same in float32."""
    return having(of, [value.float() for value in values(of)])


@pytest.mark.parametrize("joints", [1, 2])
def test_the_cross_maps_of_the_targets_are_the_placements(joints: int) -> None:
    s, at = skeleton(joints), placements(joints)
    kinds: tuple[JointKind, ...] = ("revolute",) * joints
    wanted = first_targets(s.points, lying(s, at), kinds)
    maps = part_maps(cross_maps(wanted.template_joints, wanted.joints, kinds))
    template = s.points + wanted.residual
    weights = s.weights().expand(len(template), -1, -1)
    assert_close(deform(maps, template, weights), posed(s, at, kinds), atol=1e-6, rtol=0)
    parts = posed(s, at, kinds).unflatten(1, (joints + 1, 20)).mean(2)
    assert_close(wanted.keypoints, parts, atol=1e-6, rtol=0)


def test_targets_are_made_on_the_device_of_the_clouds() -> None:
    s, at = skeleton(2), placements(2)
    own = map_tensors(lying(s, at), lambda x: x.to("meta"))
    wanted = first_targets(s.points.to("meta"), own, ("revolute", "prismatic"))
    assert wanted.joints.state.device.type == wanted.keypoints.device.type == "meta"


def test_a_slide_keeps_its_way_and_the_axis_turns_along() -> None:
    s, at = skeleton(1), placements(1)
    wanted = first_targets(s.points, lying(s, at), ("prismatic",))
    assert_close(wanted.joints.relative(), at.state, atol=1e-9, rtol=0)
    axis = torch.nn.functional.normalize(s.axis, dim=-1) @ rotvec_to_rotmat(at.turn).mT
    assert_close(wanted.joints.axis, axis, atol=1e-9, rtol=0)


def test_bones_take_over_any_precision() -> None:
    root = normal(7, 2, 3, 3)
    precision = root @ root.mT + 0.1 * torch.eye(3)
    bones = Bones(2, 0.01).double()
    bones.set_to(precision)
    assert_close(bones.precision() / 0.01, precision, atol=1e-6, rtol=1e-6)


def test_bones_turn_with_their_parts() -> None:
    """A cloud turned as a whole has the same weights if its bones are turned along."""
    bones = Bones(2, 0.01).double()
    root = normal(7, 2, 3, 3)
    bones.set_to(root @ root.mT + 0.1 * torch.eye(3))
    points, centres = 0.3 * normal(8, 4, 30, 3), 0.3 * normal(9, 4, 2, 3)
    turn = rotvec_to_rotmat(normal(10, 4, 3))
    turned = bones.weights(points @ turn.mT, centres @ turn.mT, turn[:, None].expand(-1, 2, -1, -1))
    assert_close(turned, bones.weights(points, centres), atol=1e-9, rtol=0)


def test_networks_learn_the_targets() -> None:
    s = single(skeleton(1))
    at = single(placements(1, 8))
    wanted = first_targets(s.points, lying(s, at), ("revolute",))
    networks = (
        JointNetwork(TINY.joint, CATEGORIES["laptop"]),
        KeypointNetwork(TINY.heads, 6, 2),
        ResidualNetwork(TINY.heads, 8),
    )
    for network in networks:
        initialise(network, generator(0))
    inputs = Inputs(
        template=s.points,
        aligned=posed(s, at, ("revolute",)),
        code=torch.randn(8, 6, generator=generator(1)),
        features=torch.randn(8, 40, 8, generator=generator(2)),
    )
    told = list[tuple[float, float]]()

    class Listening(Journal):
        def tell(self, words: str, done: float, left: float) -> None:
            del words
            told.append((done, left))

    history = fit_networks(networks, inputs, wanted, generator(3), 100, Listening())
    assert [done for done, _ in told] == [0.01, 0.51]
    assert all(left > 0 for _, left in told)
    assert len(history) == 2
    assert history[-1] < 0.8 * history[0]
