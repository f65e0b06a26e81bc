# SPDX-License-Identifier: MIT
"""Theta_E and Theta_D: pose moves with the cloud, the code does not; sizes as published."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from scapo.first_weights import initialise
from scapo.geometry.rigid import rotation_angle
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.paper.autoencoder import (
    Decoder,
    DecoderConfig,
    Encoder,
    EncoderConfig,
    Encoding,
    mean_encoding,
    project,
)
from tests.helpers.strategies import generator, is_rotation, normal, rotations

SMALL = EncoderConfig(neighbours=8, centres=24, pool=60, width=6, branch=(8, 12, 8, 6), features=7)
FORMS = {
    "default": SMALL,
    "all points": replace(SMALL, centres=None),
    "mean edges": replace(SMALL, edge="mean"),
    "gram-schmidt": replace(SMALL, projection="gram-schmidt"),
    "length norm": replace(SMALL, norm="length"),
    "votes": replace(SMALL, pose="votes"),
    "hypotheses": replace(SMALL, hypotheses=4),
    "hypotheses by votes": replace(SMALL, pose="votes", hypotheses=4),
}


def encoder(config: EncoderConfig) -> Encoder:
    made = Encoder(config)
    initialise(made, generator(0))
    with torch.no_grad():
        for k in range(30):
            made(0.2 * normal(k, 4, 60, 3, dtype=torch.float32))
    return made.eval()


def size(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize("name", FORMS)
def test_pose_moves_with_the_cloud_and_the_code_does_not(name: str) -> None:
    made = encoder(FORMS[name]).double()
    points, turn, shift = 0.2 * normal(9, 3, 60, 3), rotations(2, 3), normal(3, 3, 3)
    before, after = made(points), made(points @ turn.mT + shift[:, None])
    place = (turn @ before.translation[..., None])[..., 0] + shift
    assert_close(after.frame, turn @ before.frame, atol=1e-8, rtol=0)
    assert_close(after.rotation, turn @ before.rotation, atol=1e-8, rtol=0)
    assert_close(after.translation, place, atol=1e-8, rtol=0)
    assert_close(after.code, before.code, atol=1e-8, rtol=0)
    assert bool(is_rotation(after.rotation, 1e-9).all())
    assert (before.rotation - after.rotation).abs().max() > 0.1


def test_in_single_precision_to_a_thousandth() -> None:
    made = encoder(SMALL)
    points = 0.2 * normal(9, 8, 60, 3, dtype=torch.float32)
    turn, shift = rotations(2, 8, dtype=torch.float32), normal(3, 8, 3, dtype=torch.float32)
    before, after = made(points), made(points @ turn.mT + shift[:, None])
    assert_close(after.rotation, turn @ before.rotation, atol=1e-3, rtol=0)
    place = (turn @ before.translation[..., None])[..., 0] + shift
    assert_close(after.translation, place, atol=1e-3, rtol=0)
    assert_close(after.code, before.code, atol=1e-3, rtol=1e-3)


def test_the_code_tells_a_shape_from_its_mirror_image() -> None:
    made = encoder(SMALL).double()
    points = 0.2 * normal(9, 1, 60, 3)
    mirrored = points * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    assert (made(points).code - made(mirrored).code).abs().max() > 1e-3


def test_order_of_points_does_not_matter_where_all_are_centres() -> None:
    made = encoder(FORMS["all points"]).double()
    points = 0.2 * normal(9, 1, 60, 3)
    shuffled = points[:, torch.randperm(60, generator=generator(1))]
    assert_close(made(points).code, made(shuffled).code)
    assert_close(made(points).rotation, made(shuffled).rotation)


def test_align_and_place_are_inverse() -> None:
    encoding = encoder(SMALL)(0.2 * normal(9, 2, 60, 3, dtype=torch.float32))
    points = normal(4, 2, 5, 3, dtype=torch.float32)
    assert_close(encoding.place(encoding.align(points)), points)
    zero = torch.zeros(2, 1, 3)
    assert_close(encoding.place(zero)[:, 0], encoding.translation)


@pytest.mark.parametrize("name", ["hypotheses", "hypotheses by votes"])
def test_of_the_hypotheses_the_one_counts_that_explains_a_cloud_best(name: str) -> None:
    config, points = FORMS[name], 0.2 * normal(9, 3, 60, 3)
    encoding = encoder(config).double()(points)
    assert encoding.frames is not None
    turns = project(encoding.frames, config)
    some, others = (turns[:, row, :] for row in ([0, 0, 0, 1, 1, 2], [1, 2, 3, 2, 3, 3]))
    apart = rotation_angle(some, others)
    assert apart.amax(1).min() > 0.1  # they differ
    wanted = torch.tensor([2, 0, 3])
    shape = encoding.by(wanted, config).align(points)
    for found in (
        encoding.nearest(points, shape, config),
        encoding.facing(turns[[0, 1, 2], wanted], config),
    ):
        assert found.chosen is not None
        assert found.chosen.tolist() == wanted.tolist()
        assert_close(found.rotation, turns[[0, 1, 2], wanted])
        assert_close(found.frame, encoding.frames[[0, 1, 2], wanted])


def test_a_cloud_without_a_hypothesis_is_refused() -> None:
    with pytest.raises(ValueError, match="expected at least 1 hypothesis, found 0"):
        EncoderConfig(hypotheses=0)


def test_one_hypothesis_is_never_exchanged() -> None:
    points = 0.2 * normal(9, 3, 60, 3)
    encoding = encoder(SMALL).double()(points)
    assert encoding.nearest(points, points.flip(0), SMALL) is encoding
    assert encoding.facing(rotations(1, 3), SMALL) is encoding
    assert encoding.by(None, SMALL) is encoding


def test_votes_that_are_the_points_themselves_give_the_rotation_between_them() -> None:
    made, points = encoder(FORMS["votes"]).double(), 0.2 * normal(9, 3, 60, 3)
    turn = rotations(2, 3)
    made.register_module("pose", nn.Identity())  # votes are what it is given
    frames = made.frames(points.mT, points, points @ turn.mT)
    assert_close(project(frames[:, 0], SMALL), turn)


def test_sizes_are_the_published_ones_within_three_percent() -> None:
    made = Encoder(EncoderConfig())
    assert size(made.pose) == 510
    assert size(made) - 510 == pytest.approx(337_704, rel=0.03)
    assert EncoderConfig().code == 1020
    assert size(Decoder(DecoderConfig(), 1020)) == pytest.approx(13.6e6, rel=0.03)


def test_the_decoder_gives_points_and_their_features() -> None:
    made = Decoder(DecoderConfig(patches=3, points=12, widths=(7, 6, 5)), 9)
    initialise(made, generator(0))
    shape, features = made.eval()(normal(1, 2, 9, dtype=torch.float32))
    assert shape.shape == (2, 12, 3)
    assert features.shape == (2, 12, 5)
    assert shape.abs().max() <= 1


def test_a_patch_depends_on_its_own_weights_alone() -> None:
    made = Decoder(DecoderConfig(patches=3, points=12, widths=(7, 6, 5)), 9)
    initialise(made, generator(0))
    made.eval()
    code = normal(1, 2, 9, dtype=torch.float32)
    before, _ = made(code)
    with torch.no_grad():
        made.out.weight[1] += 1
    changed = (made(code)[0] - before).abs().amax((0, 2)) > 0
    assert changed.tolist() == [False] * 4 + [True] * 4 + [False] * 4


def test_batched_patches_equal_one_network_per_patch() -> None:
    config = DecoderConfig(patches=2, points=6, widths=(7, 6, 5))
    made = Decoder(config, 4)
    initialise(made, generator(0))
    made.eval()
    code = normal(1, 1, 4, dtype=torch.float32)
    shape, _ = made(code)
    grid = made.grid[1, :, 2]  # third point of the second patch
    x = made.from_code.weight.unflatten(0, (2, 7))[1] @ code[0]
    x = x + made.from_grid.weight[1] @ grid + made.from_grid.bias[1, :, 0]
    for number in range(3):
        x = torch.relu(x / (1 + 1e-5) ** 0.5)  # batch norm as it starts
        layer = made.hidden[number] if number < 2 else made.out
        x = layer.weight[1] @ x + layer.bias[1, :, 0]  # pyright: ignore[reportIndexIssue]
    assert_close(shape[0, 5], torch.tanh(x))


def test_points_that_do_not_divide_are_refused() -> None:
    with pytest.raises(ValueError, match="expected points a multiple of 8 patches, found 1001"):
        DecoderConfig(points=1001)


def said(turns: Tensor, shift: float = 0.0) -> Encoding:
    """Of clouds."""
    ones = turns.new_ones(len(turns), 3)
    return Encoding(frame=turns, rotation=turns, translation=shift * ones, code=shift * ones)


def test_looks_that_agree_are_averaged_and_one_that_is_turned_round_is_left_out() -> None:
    truth = rotations(3, 5)
    small = rotvec_to_rotmat(0.2 * normal(4, 6, 5, 3))
    around = rotvec_to_rotmat(torch.tensor([0.0, 0.0, 3.0]).double())
    looks = [said(truth @ turn, 0.1) for turn in small] + [said(truth @ around, 9.0)]
    found = mean_encoding(looks)
    assert is_rotation(found.rotation).all()
    off = rotation_angle(found.rotation, truth)
    single = torch.stack([rotation_angle(look.rotation, truth) for look in looks[:6]])
    assert bool((off < single.mean(0)).all())
    # To first order the mean turn is that of the turns' mean.
    expected = torch.linalg.norm(0.2 * normal(4, 6, 5, 3).mean(0), dim=-1)
    assert_close(off, expected, atol=0.03, rtol=0)
    assert_close(found.translation, torch.full((5, 3), 0.1).double())
    assert_close(found.code, torch.full((5, 3), 0.1).double())


def test_looks_of_one_answer_are_that_answer() -> None:
    one = said(rotations(3, 5), 0.3)
    found = mean_encoding([one, one, one])
    assert_close(found.rotation, one.rotation)
    assert_close(found.code, one.code)
