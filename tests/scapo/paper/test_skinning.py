# SPDX-License-Identifier: MIT
"""Bones, weights and maps between spaces, against the formulas written out point by point."""

from __future__ import annotations

import math

import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from scapo.categories import JointKind
from scapo.geometry.rigid import apply
from scapo.paper import skinning
from scapo.paper.heads import JointPairs
from tests.helpers.strategies import normal, seeds, unit_vectors

quick = settings(max_examples=15, deadline=None)


def joint_pairs(seed: int, count: int = 1, batch: int = 2) -> JointPairs:
    return JointPairs(
        pivot=0.3 * normal(seed, batch, count, 3),
        axis=unit_vectors(seed + 1, batch, count),
        state=normal(seed + 2, batch, count, 2),
    )


def bones(seed: int, parts: int = 3) -> skinning.Bones:
    made = skinning.Bones(parts, 0.05).double()
    with torch.no_grad():
        made.quaternion.copy_(normal(seed, parts, 4))
        made.log_scale.copy_(normal(seed + 1, parts, 3))
    return made


@quick
@given(seed=seeds)
def test_weights_are_the_softmax_of_mahalanobis_distances(seed: int) -> None:
    made, points, centres = (
        bones(seed),
        0.3 * normal(seed + 2, 2, 5, 3),
        0.3 * normal(seed, 2, 3, 3),
    )
    found = made.weights(points, centres)
    for b, i in ((0, 0), (1, 4)):
        distance = []
        for p in range(3):
            q = made.quaternion[p] / made.quaternion[p].norm()
            V, scale = roma.unitquat_to_rotmat(q), torch.diag(made.log_scale[p].exp())
            offset = points[b, i] - centres[b, p]
            distance.append(offset @ (V.T @ scale @ V) @ offset)
        wanted = torch.softmax(-torch.stack(distance) / made.log_gamma.exp(), 0)
        assert_close(found[b, i], wanted, atol=1e-9, rtol=1e-7)
    assert_close(found.sum(-1), torch.ones(2, 5, dtype=torch.float64))


def test_bones_start_round_at_the_given_gamma() -> None:
    made = skinning.Bones(2, 0.01)
    assert_close(made.precision(), torch.eye(3).expand(2, 3, 3))
    assert made.log_gamma.exp().item() == pytest.approx(0.01)


def test_smaller_gamma_is_sharper() -> None:
    points, centres = 0.3 * normal(1, 1, 9, 3), 0.3 * normal(2, 1, 3, 3)
    soft, sharp = (skinning.Bones(3, g).double().weights(points, centres) for g in (1.0, 0.01))
    assert bool((sharp.amax(-1) > soft.amax(-1)).all())
    assert torch.equal(sharp.argmax(-1), soft.argmax(-1))


@quick
@given(seed=seeds, kind=st.sampled_from(["revolute", "prismatic"]))
def test_bone_maps_follow_the_three_steps(seed: int, kind: JointKind) -> None:
    joints, x = joint_pairs(seed), normal(seed + 5, 3)
    maps = skinning.incident_maps(joints, (kind,))
    c, d, a = joints.pivot[1, 0], joints.axis[1, 0], joints.state[1, 0, 1]
    wanted = roma.rotvec_to_rotmat(d * a) @ (x - c) + c if kind == "revolute" else x + d * a
    assert_close(apply(maps[1, 0, 1], x[None])[0], wanted)


@quick
@given(seed=seeds, kind=st.sampled_from(["revolute", "prismatic"]))
def test_cross_maps_follow_the_corrected_equation(seed: int, kind: JointKind) -> None:
    source, target, x = joint_pairs(seed), joint_pairs(seed + 7), normal(seed + 5, 3)
    maps = skinning.cross_maps(source, target, (kind,))
    for side in (0, 1):
        c_x, d_x, a_x = source.pivot[0, 0], source.axis[0, 0], source.state[0, 0, side]
        c_y, d_y, a_y = target.pivot[0, 0], target.axis[0, 0], target.state[0, 0, side]
        normal_ = torch.linalg.cross(d_x, d_y)
        angle = torch.atan2(normal_.norm(), d_x @ d_y)
        turn = roma.rotvec_to_rotmat(normal_ / normal_.norm() * angle)  # R_r
        relative = roma.rotvec_to_rotmat(d_y * (a_y - a_x))
        if kind == "revolute":
            wanted = relative @ turn @ (x - c_x) + c_y
        else:
            wanted = turn @ (x - c_x) + c_y + d_y * (a_y - a_x)
        assert_close(apply(maps[0, 0, side], x[None])[0], wanted, atol=1e-9, rtol=1e-7)


@quick
@given(seed=seeds, kind=st.sampled_from(["revolute", "prismatic"]))
def test_cross_maps_there_and_back_are_inverse_for_each_part(seed: int, kind: JointKind) -> None:
    x, y = joint_pairs(seed, 2), joint_pairs(seed + 7, 2)
    there, back = skinning.cross_maps(x, y, (kind,) * 2), skinning.cross_maps(y, x, (kind,) * 2)
    eye = torch.eye(4, dtype=torch.float64).expand_as(there)
    assert_close(there @ back, eye, atol=1e-9, rtol=0)


def test_the_pivot_lands_on_the_pivot() -> None:
    x, y = joint_pairs(1), joint_pairs(2)
    maps = skinning.cross_maps(x, y, ("revolute",))
    assert_close(apply(maps[:, 0], x.pivot[:, None])[:, :, 0], y.pivot.expand(2, 2, 3))


@quick
@given(seed=seeds)
def test_the_cycle_closes_for_hard_weights_and_not_for_blended_ones(seed: int) -> None:
    maps = skinning.part_maps(skinning.incident_maps(joint_pairs(seed), ("revolute",)))
    points = normal(seed + 3, 2, 6, 3)
    hard = torch.nn.functional.one_hot(torch.arange(6) % 2, 2).double().expand(2, 6, 2)
    there = skinning.to_canonical(maps, points, hard)
    assert_close(skinning.deform(maps, there, hard), points, atol=1e-10, rtol=0)
    soft = torch.full_like(hard, 0.5)
    back = skinning.deform(maps, skinning.to_canonical(maps, points, soft), soft)
    turn = (maps[:, 1, :3, :3] - maps[:, 0, :3, :3]).abs().max()
    assert (back - points).abs().max() > 1e-3 * turn


def test_deform_is_the_blended_matrix() -> None:
    maps = skinning.incident_maps(joint_pairs(1), ("revolute",))[:, 0]
    points, weights = normal(2, 2, 5, 3), torch.softmax(normal(3, 2, 5, 2), -1)
    blended = torch.einsum("bnp,bpij->bnij", weights, maps)
    homogeneous = torch.cat([points, torch.ones(2, 5, 1, dtype=torch.float64)], -1)
    wanted = (blended @ homogeneous[..., None])[..., :3, 0]
    assert_close(skinning.deform(maps, points, weights), wanted)


def test_two_joints_average_the_base() -> None:
    joints = JointPairs(
        pivot=torch.zeros(1, 2, 3, dtype=torch.float64),
        axis=torch.tensor([[[0.0, 0, 1], [0, 0, 1]]], dtype=torch.float64),
        state=torch.tensor([[[0.2, 1.0], [0.6, -1.0]]], dtype=torch.float64),
    )
    incident = skinning.incident_maps(joints, ("revolute", "revolute"))
    maps = skinning.part_maps(incident)
    angles = torch.atan2(maps[0, :, 1, 0], maps[0, :, 0, 0])
    assert_close(angles, torch.tensor([0.4, 1.0, -1.0], dtype=torch.float64))
    points = torch.tensor([[[1.0, 0, 0]]], dtype=torch.float64)
    weights = torch.tensor([[[0.5, 0.25, 0.25]]], dtype=torch.float64)
    chord = 2 * math.sin(0.2)
    found = skinning.base_gap(incident, points, weights)
    assert found.item() == pytest.approx(0.5 * chord**2)


def test_one_joint_has_no_gap() -> None:
    incident = skinning.incident_maps(joint_pairs(1), ("revolute",))
    points, weights = normal(2, 2, 5, 3), torch.full((2, 5, 2), 0.5, dtype=torch.float64)
    assert skinning.base_gap(incident, points, weights) == 0
    assert_close(skinning.part_maps(incident), incident[:, 0])
