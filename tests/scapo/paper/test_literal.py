# SPDX-License-Identifier: MIT
"""Preset `literal`: its terms against the printed formulas, written out once more in loops."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.categories import CATEGORIES
from scapo.paper.config import literal_config
from scapo.paper.method import Scapo
from scapo.paper.objectives import Explanation, articulation
from scapo.paper.skinning import Bones
from scapo.types import Labels, Observation
from tests.helpers.strategies import generator, normal
from tests.helpers.tiny import TINY, tiny
from tests.scapo.paper.test_objectives import explanation

LOSS = literal_config().loss


def soft_explanation() -> tuple[Explanation, Bones]:
    """Two blobs and a joint, with weights that are nowhere 0 or 1 and a residual."""
    e = explanation()
    bones = Bones(2, 0.2).double()
    keypoints = e.keypoints + 0.02 * normal(1, *e.keypoints.shape)
    template_keypoints = e.template_keypoints + 0.02 * normal(2, *e.keypoints.shape)
    soft = replace(
        e,
        residual=0.01 * normal(3, *e.template.shape),
        keypoints=keypoints,
        template_keypoints=template_keypoints,
        weights=bones.weights(e.aligned, keypoints),
        template_weights=bones.weights(e.template, template_keypoints),
    )
    return soft, bones


def entropies(weights: Tensor) -> list[float]:
    return [-sum(w * math.log(w) for w in row) for row in weights[0].tolist()]


def boundary(pivot: Tensor, points: Tensor, weights: Tensor) -> float:
    """- sum_i alpha_i H_i for one joint, alpha a softmax of minus the distances."""
    share = [math.exp(-math.dist(pivot[0, 0].tolist(), s)) for s in points[0].tolist()]
    pairs = zip(share, entropies(weights), strict=True)
    return -sum(a * h for a, h in pairs) / sum(share)


def proximity(pivot: Tensor, points: Tensor) -> float:
    nearest = min(math.dist(pivot[0, 0].tolist(), s) for s in points[0].tolist())
    return 1 - math.exp(-30 * nearest**2)


def chamfer(a: Tensor, b: Tensor) -> float:
    def one_way(x: Tensor, y: Tensor) -> float:
        rows, others = x[0].tolist(), y[0].tolist()
        return sum(min(math.dist(p, q) for q in others) ** 2 for p in rows) / len(rows)

    return one_way(a, b) + one_way(b, a)


def test_weights_and_schedule_are_those_printed() -> None:
    config = literal_config()
    assert (LOSS.rec, LOSS.ortho, LOSS.aug, LOSS.can) == (1, 0.1, 0.1, 0.1)
    assert (LOSS.cycle, LOSS.recon, LOSS.kp_seg, LOSS.seg) == (10, 10, 1, 1)
    assert (LOSS.shape_var, LOSS.dir_align, LOSS.joint_prox, LOSS.joint_boundary) == (10, 0.1, 1, 3)
    unprinted = (LOSS.rec_aligned, LOSS.base_gap, LOSS.state_gauge, LOSS.part_mass)
    assert unprinted == (0, 0, 0, 0)
    model = Scapo(config, CATEGORIES["laptop"], generator(0))
    first, second = model.stages()
    assert (first.epochs, second.epochs) == (200, 200)
    assert (first.lr, second.lr, second.min_lr, second.weight_decay) == (1e-3, 1e-4, 1e-6, 1e-8)
    assert {(group.rate, group.begin) for group in second.parameters} == {(1.0, 0.0)}
    assert {"encoder", "decoder"} <= {group.module for group in second.parameters}
    assert model.variant == "literal"


def test_stage_2_sums_the_printed_terms() -> None:
    e, bones = soft_explanation()
    found = articulation(e, bones, ("revolute",), LOSS)
    x, y = e.joints, e.template_joints
    assert found["joint_boundary"].item() == pytest.approx(
        3 * (boundary(x.pivot, e.aligned, e.weights)
             + boundary(y.pivot, e.template, e.template_weights))
    )  # fmt: skip
    whole = e.residual.square().sum().item()
    assert found["shape_var"].item() == pytest.approx(10 * (1 - math.exp(-60 * whole)))
    w, points, keypoints = e.weights[0], e.aligned[0], e.keypoints[0]
    nearest = torch.cdist(points, keypoints).argmin(1)
    own = sum((w[i] - torch.eye(2)[nearest[i]]).square().sum().item() for i in range(len(w)))
    assert found["seg"].item() > own / len(w)  # and the same on S*
    assert "base_gap" not in found
    assert "state_gauge" not in found
    assert found["joint_prox"].item() >= proximity(y.pivot, e.template) - 1e-9


def test_the_chamfer_distance_is_squared_and_both_ways() -> None:
    e, bones = soft_explanation()
    same = replace(e.joints, state=torch.zeros_like(e.joints.state))
    still = replace(e, joints=same)  # no motion: x2y is the cloud itself
    found = articulation(still, bones, ("revolute",), LOSS)
    assert found["recon"].item() == pytest.approx(10 * chamfer(e.aligned, e.template))
    assert found["recon_template"].item() == pytest.approx(10 * chamfer(e.aligned, e.template))


def test_nothing_is_held_constant() -> None:
    """Entropies and points take gradients, in `literal` alone."""
    e, bones = soft_explanation()
    for config, flows in ((LOSS, True), (TINY.loss, False)):
        weights = e.weights.detach().requires_grad_()
        term = articulation(replace(e, weights=weights), bones, ("revolute",), config)
        (gradient,) = torch.autograd.grad(term["joint_boundary"], weights, allow_unused=True,
                                          materialize_grads=True) if flows else (None,)  # fmt: skip
        assert term["joint_boundary"].requires_grad == flows
        assert gradient is None or gradient.abs().max() > 0
        template = e.template.detach().requires_grad_()
        near = articulation(replace(e, template=template), bones, ("revolute",), config)
        assert near["joint_prox"].requires_grad == flows


def test_all_networks_learn_from_the_first_step() -> None:
    loss = replace(LOSS, disturbances_per_step=1)
    config = replace(TINY, loss=loss, encoder_in_stage_2="end-to-end", template_start="random")
    model = tiny(config=replace(config, joint=replace(TINY.joint, base_fixed=False)))
    model.train()
    before = {k: v.clone() for k, v in model.encoder.state_dict().items()}
    from tests.scapo.paper.test_method import ARTICULATE, at

    points = 0.2 * torch.randn(4, 96, 3, generator=generator(0))
    terms = model.losses(Observation(points=points), Labels(), at(ARTICULATE, 0.0, 1))
    torch.stack(list(terms.values())).sum().backward()
    assert all(
        p.grad is not None and p.grad.abs().sum() > 0 for p in model.encoder.pose.parameters()
    )
    assert any(not torch.equal(v, before[k]) for k, v in model.encoder.state_dict().items())


def test_both_states_of_a_joint_are_free() -> None:
    config = replace(TINY, joint=replace(TINY.joint, base_fixed=literal_config().joint.base_fixed))
    points = 0.2 * torch.randn(4, 96, 3, generator=generator(0))
    free, fixed = tiny(config=config), tiny()
    assert free.joint_network(points).state[..., 0].abs().min() > 0
    assert_close(fixed.joint_network(points).state[..., 0], torch.zeros(4, 1))
