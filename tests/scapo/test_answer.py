# SPDX-License-Identifier: MIT
"""Doors at the other side: mirrored answers are those of mirrored objects; who is asked both."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.testing import assert_close

from scapo import answer
from scapo.alignment import unit_length
from scapo.answer import ASIDE, hangs_aside, mirrored
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.predictor import Predictor, load
from scapo.records import map_tensors
from scapo.types import Joints, Prediction

MIRROR = torch.tensor(ASIDE)


def door() -> Prediction:
    """Three answers about a body and a door, with a shape of twenty points."""
    draw = torch.Generator().manual_seed(3)
    pose = torch.eye(4).repeat(3, 2, 1, 1)
    pose[..., :3, :3] = rotvec_to_rotmat(torch.randn(3, 2, 3, generator=draw))
    pose[..., :3, 3] = torch.randn(3, 2, 3, generator=draw)
    pivot, axis = torch.randn(2, 3, 1, 3, generator=draw)
    return Prediction(
        part_weight=torch.rand(3, 7, 2, generator=draw),
        camera_T_part=pose,
        joints=Joints(pivot=pivot, axis=axis, state=torch.rand(3, 1, generator=draw)),
        canonical_points=torch.randn(3, 20, 3, generator=draw),
        canonical_normals=torch.randn(3, 20, 3, generator=draw),
        canonical_part=torch.randint(2, (3, 20), generator=draw),
    )


def surface(said: Prediction) -> Tensor:
    """The points of the shape where they are observed."""
    assert said.camera_T_part is not None
    assert said.canonical_points is not None
    assert said.canonical_part is not None
    pose = said.camera_T_part.take_along_dim(said.canonical_part[..., None, None], 1)
    turned = pose[..., :3, :3] @ said.canonical_points[..., None]
    return turned[..., 0] + pose[..., :3, 3]


def tensors(record: Prediction) -> list[Tensor]:
    """All that it has."""
    found: list[Tensor] = []
    map_tensors(record, lambda tensor: found.append(tensor) or tensor)
    return found


def opened(said: Prediction, angle: float, points: Tensor) -> Tensor:
    """Points turned about the joint."""
    joints = said.joints
    assert joints is not None
    turn = rotvec_to_rotmat(angle * torch.nn.functional.normalize(joints.axis, dim=-1))
    return (points - joints.pivot) @ turn[:, 0].mT + joints.pivot


def test_a_mirrored_answer_is_that_of_the_mirrored_object() -> None:
    said, points = door(), torch.randn(3, 5, 3, generator=torch.Generator().manual_seed(4))
    other = mirrored(said)
    assert other.camera_T_part is not None
    assert_close(torch.linalg.det(other.camera_T_part), torch.ones(3, 2))
    assert_close(surface(other), MIRROR * surface(said))
    assert_close(opened(other, 0.7, MIRROR * points), MIRROR * opened(said, 0.7, points))
    assert_close(tensors(mirrored(other)), tensors(said))
    plain = replace(said, camera_T_part=None, joints=None, canonical_points=None)
    assert mirrored(replace(plain, canonical_normals=None)).part_weight is said.part_weight


@pytest.mark.parametrize(
    "name", ["laptop", "safe", "eyeglasses", "oven", "washer", "drawer", "scissors", "suitcase"]
)
def test_only_doors_with_an_upright_hinge_are_looked_for_at_both_sides(name: str) -> None:
    assert hangs_aside(load(name).model) == (name in ("safe", "washer"))


@pytest.fixture(scope="module")
def safes() -> tuple[Predictor, Tensor, Tensor]:
    """The released model, clouds, and the up that it finds without being told."""
    points = load_file("results/checks/safe.safetensors")["points"][:4]
    model = load("safe")
    pose = model.predict(points).camera_T_part
    assert pose is not None
    return model, points, pose[:, 0, :3, 2]


@pytest.mark.parametrize("mode", ["fast", "quick"])
def test_a_door_is_found_at_either_side_by_who_knows_up(
    safes: tuple[Predictor, Tensor, Tensor], mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, points, up = safes
    found = model.predict(points, mode, up=up)  # pyright: ignore[reportArgumentType]
    other = model.predict(MIRROR * points, mode, up=MIRROR * up)  # pyright: ignore[reportArgumentType]
    assert_close(tensors(other), tensors(mirrored(found)), atol=1e-3, rtol=1e-3)
    monkeypatch.setattr(answer, "hangs_aside", lambda method: False)
    one = model.predict(MIRROR * points, mode, up=MIRROR * up)  # pyright: ignore[reportArgumentType]
    assert one.joints is not None
    assert other.joints is not None
    apart = (one.joints.pivot - other.joints.pivot).norm(dim=-1) / unit_length(points)[:, None]
    assert apart.median() > 0.1  # on the wrong side of the body


def test_own_frames_whole_surfaces_and_clouds_without_an_up_are_asked_once(
    safes: tuple[Predictor, Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, points, up = safes
    monkeypatch.setattr(answer, "mirrored", lambda found: pytest.fail("asked twice"))
    model.predict(points, "fast")
    model.predict(points, "fast", up=up, own_frame=True)
    model.predict(points[0], "whole", up=up[0])
