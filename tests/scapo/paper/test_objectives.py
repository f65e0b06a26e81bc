# SPDX-License-Identifier: MIT
"""Which terms a stage sums, with which weights, and what a perfect explanation costs."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.categories import JointKind
from scapo.first_weights import initialise
from scapo.geometry.rigid import apply, joint_motion
from scapo.paper.autoencoder import Decoder, DecoderConfig, Encoder, EncoderConfig, Encoding
from scapo.paper.heads import JointPairs
from scapo.paper.objectives import (
    AblatedTerm,
    Explanation,
    LossConfig,
    articulation,
    canonicalisation,
    deform_all,
    sum_of,
    weigh,
)
from scapo.paper.skinning import Bones
from tests.helpers.strategies import generator, normal

BASE = {"cycle", "cycle_template", "recon", "recon_template", "kp_seg", "seg", "base_gap"}


def explanation(kind: JointKind = "revolute", state: float = 0.4) -> Explanation:
    """A template of two separate blobs and the cloud that its one joint makes of it."""
    blobs = torch.tensor([[-0.3, 0, 0], [0.3, 0, 0]], dtype=torch.float64)
    template = (blobs[:, None] + 0.03 * normal(0, 2, 40, 3)).flatten(0, 1)[None]
    pivot = torch.zeros(1, 1, 3, dtype=torch.float64)
    axis = torch.tensor([[[0.0, 0, 1]]], dtype=torch.float64)
    motion = joint_motion(pivot[:, 0], axis[:, 0], torch.tensor([state]).double(), kind)
    moved = apply(motion, template)
    aligned = torch.cat([template[:, :40], moved[:, 40:]], 1)
    keypoints = torch.stack([aligned[:, :40].mean(1), aligned[:, 40:].mean(1)], 1)
    bones = Bones(2, 0.001).double()
    eye, zero = torch.eye(3).double()[None], torch.zeros(1, 3).double()

    def joints(a: float) -> JointPairs:
        return JointPairs(pivot=pivot, axis=axis, state=torch.tensor([[[0.0, a]]]).double())

    return Explanation(
        encoding=Encoding(frame=eye, rotation=eye, translation=zero, code=zero),
        aligned=aligned,
        template=template,
        residual=torch.zeros_like(template),
        keypoints=keypoints,
        template_keypoints=blobs[None],
        joints=joints(state),
        template_joints=joints(0.0),
        weights=bones.weights(aligned, keypoints),
        template_weights=bones.weights(template, blobs[None]),
    )


def terms(config: LossConfig, kind: JointKind = "revolute") -> dict[str, Tensor]:
    return articulation(explanation(kind), Bones(2, 0.001).double(), (kind,), config)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_the_true_joint_costs_nothing(kind: JointKind) -> None:
    found = terms(LossConfig(state_gauge=1, part_mass=1), kind)
    for name in (*BASE - {"kp_seg"}, "shape_var", "state_gauge", "part_mass"):
        assert found[name].item() == pytest.approx(0, abs=1e-6), name
    assert found["kp_seg"].item() < 1e-3
    assert ("dir_align" in found) == (kind == "revolute")


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_wrong_state_costs(kind: JointKind) -> None:
    e = explanation(kind)
    wrong = replace(e, joints=replace(e.joints, state=e.joints.state + torch.tensor([0.0, 0.5])))
    found = articulation(wrong, Bones(2, 0.001).double(), (kind,), LossConfig())
    assert found["recon"] > 0.01
    assert found["recon_template"] > 0.01
    assert found["cycle"].item() == pytest.approx(0, abs=1e-6)


def test_deformations_land_where_they_should() -> None:
    e = explanation()
    d = deform_all(e, Bones(2, 0.001).double(), ("revolute",))
    assert_close(d.x2y, e.template, atol=1e-6, rtol=0)
    assert_close(d.y2x, e.aligned, atol=1e-6, rtol=0)
    assert_close(d.canonical, e.template, atol=1e-6, rtol=0)
    assert_close(d.canonical_keypoints, e.template_keypoints, atol=0.02, rtol=0)


@pytest.mark.parametrize("left_out", get_args(AblatedTerm))
def test_each_ablated_term_is_a_switch(left_out: AblatedTerm) -> None:
    all_of_them = terms(LossConfig())
    found = terms(LossConfig(without=(left_out,)))
    assert set(all_of_them) - set(found) == {left_out}
    for name, value in found.items():
        assert_close(value, all_of_them[name])


def test_weights_are_the_papers() -> None:
    e, config = explanation(), LossConfig()
    wrong = replace(
        e, residual=e.residual + 0.1, joints=replace(e.joints, pivot=e.joints.pivot + 1)
    )
    bones = Bones(2, 0.001).double()
    wanted = {"cycle": 10, "cycle_template": 10, "recon": 10, "recon_template": 10, "kp_seg": 1,
              "seg": 1, "shape_var": 10, "dir_align": 0.1, "joint_prox": 1, "joint_boundary": 3,
              "base_gap": 10}  # fmt: skip
    ones = {name: 1.0 for name in wanted if not name.endswith("_template")}
    plain = articulation(wrong, bones, ("revolute",), replace(config, **ones))
    weighted = articulation(wrong, bones, ("revolute",), config)
    assert set(weighted) == set(wanted)
    for name, factor in wanted.items():
        assert_close(weighted[name], factor * plain[name])
    stage_1 = (config.rec, config.rec_aligned, config.ortho, config.aug, config.can)
    assert stage_1 == (1.0, 0.1, 0.1, 0.1, 0.1)


@pytest.mark.parametrize("hypotheses", [1, 3])
def test_a_pose_that_views_of_the_shape_do_not_give_back_costs(hypotheses: int) -> None:
    config = EncoderConfig(
        neighbours=8, centres=24, pool=60, width=6, branch=(8, 12, 8, 6), features=7,
        hypotheses=hypotheses,
    )  # fmt: skip
    encoder, decoder = (
        Encoder(config),
        Decoder(DecoderConfig(patches=2, points=64, widths=(8, 8, 8)), config.code),
    )
    for network in (encoder, decoder):
        initialise(network, generator(0))
    points = 0.2 * normal(1, 4, 60, 3, dtype=torch.float32)
    chosen = LossConfig(views=2.0, disturbances=("noise",))
    terms = canonicalisation(encoder, decoder, points, chosen, generator(1))
    assert set(terms) == {"rec", "rec_aligned", "ortho", "aug", "can", "views"}
    assert 0.2 < terms["views"].item() < 5  # 1 - cos of what is not learned, twice
    terms["views"].backward()
    assert all(p.grad is None for p in decoder.parameters())  # the shape is what it is
    assert encoder.edge.feature.weight.grad is not None
    assert encoder.edge.feature.weight.grad.abs().sum() > 0


def test_terms_of_weight_zero_are_not_computed() -> None:
    def never() -> Tensor:
        raise AssertionError("computed")

    found = weigh({"seg": lambda: torch.tensor(2.0), "recon": never}, LossConfig(seg=3, recon=0))
    assert {name: value.item() for name, value in found.items()} == {"seg": 6.0}


def test_sum_of() -> None:
    assert sum_of(torch.tensor(float(k)) for k in range(4)).item() == 6
