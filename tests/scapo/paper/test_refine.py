# SPDX-License-Identifier: MIT
"""Refinement finds a known disturbance again, and never makes a fit worse."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from scapo.categories import JointKind
from scapo.geometry.points import normalise
from scapo.paper.method import Scapo
from scapo.paper.objectives import Explanation
from scapo.paper.refine import (
    misfit,
    moved,
    posed_template,
    refine,
    smoothed_template_weights,
)
from scapo.types import Observation
from tests.helpers.hinged import plates
from tests.helpers.strategies import normal
from tests.helpers.tiny import TINY, tiny
from tests.scapo.paper.test_objectives import explanation


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_a_disturbed_explanation_is_put_right(kind: JointKind) -> None:
    e = explanation(kind)
    points = e.aligned
    change = 0.08 * normal(1, 1, 6)
    joint = torch.zeros(1, 1, 7, dtype=torch.float64)
    joint[..., 6] = 0.15
    wrong = moved(e, change, joint)
    assert misfit(points, e, (kind,)).item() == pytest.approx(0, abs=1e-9)
    before = misfit(points, wrong, (kind,)).item()
    found = refine(points, wrong, (kind,), steps=80)
    assert misfit(points, found, (kind,)).item() < 0.1 * before


def test_nothing_changes_where_nothing_can_be_better() -> None:
    e = explanation()
    found = refine(e.aligned, e, ("revolute",), steps=5)
    assert_close(found.encoding.rotation, e.encoding.rotation, atol=1e-6, rtol=0)
    assert_close(found.joints.state, e.joints.state, atol=1e-6, rtol=0)


def test_no_cloud_fits_worse_than_before() -> None:
    model = tiny().eval()
    points = plates(6, 96)[0].points
    points = 0.25 * (points - points.mean(1, keepdim=True))
    with torch.no_grad():
        e = model.explain(points)
        found = refine(points, e, model.kinds, steps=10)
        assert bool((misfit(points, found, model.kinds) <= misfit(points, e, model.kinds)).all())


def test_the_base_state_stays_fixed_and_axes_stay_unit() -> None:
    e = explanation()
    found = moved(e, torch.zeros(1, 6).double(), torch.ones(1, 1, 7).double())
    assert found.joints.state[0, 0].tolist() == pytest.approx([0.0, 1.4])
    assert found.joints.axis.norm().item() == pytest.approx(1)


def test_predict_refines_on_demand_and_leaves_weights_alone() -> None:
    model = tiny().eval()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    observation = Observation(points=plates(3, 96)[0].points)
    fast, slow = model.predict(observation), model.predict(observation, "refine")
    assert slow.joints is not None
    assert fast.joints is not None
    assert not torch.equal(slow.joints.pivot, fast.joints.pivot)
    assert not slow.joints.pivot.requires_grad
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())


def test_labels_of_the_template_are_those_of_its_nearest_point() -> None:
    model = tiny(config=replace(TINY, labels_of="template")).eval()
    points = plates(3, 96)[0].points
    with torch.no_grad():
        cloud, _ = normalise(points)
        e = model.explain(cloud)
        posed = posed_template(e, model.kinds)
    found = model.predict(Observation(points=points)).part_weight
    index = torch.cdist(cloud, posed).argmin(-1)
    expected = torch.stack([w[i] for w, i in zip(e.template_weights, index, strict=True)])
    assert_close(found, expected)
    assert not torch.equal(found, e.weights)


def told_otherwise(seed: int) -> tuple[Scapo, Tensor, Explanation]:
    """A model, normalised clouds, and what it says of them if parts are told the other way round.

    Whatever the bones say.
    """
    model = tiny(config=replace(TINY, labels_of="told")).eval()
    cloud, _ = normalise(plates(seed, 96)[0].points)
    with torch.no_grad():
        e = model.explain(cloud)
        model.template.part.copy_(e.template_weights[0].argmin(-1))
        told = F.one_hot(model.template.part.long(), 2).to(cloud).expand_as(e.template_weights)
    return model, cloud, replace(e, template_weights=told)


@torch.no_grad()
def test_parts_that_were_told_are_those_of_the_points_around_as_they_pose_them() -> None:
    model, cloud, e = told_otherwise(3)
    found = model.predict(Observation(points=plates(3, 96)[0].points))
    off, index = torch.cdist(cloud, posed_template(e, model.kinds)).topk(12, largest=False)
    share = torch.exp(-off.square() / (2 * 0.04**2))
    expected = (share[..., None] * e.template_weights[0][index]).sum(2) / share.sum(2)[..., None]
    assert_close(found.part_weight, expected, atol=1e-4, rtol=0)
    assert found.canonical_part is not None
    assert torch.equal(found.canonical_part[0], model.template.part.long())


@torch.no_grad()
def test_told_parts_are_what_refinement_moves() -> None:
    model, cloud, e = told_otherwise(3)
    found = model.predict(Observation(points=plates(3, 96)[0].points), "refine")
    fitted = refine(cloud, e, model.kinds)
    assert misfit(cloud, fitted, model.kinds).mean() <= misfit(cloud, e, model.kinds).mean()
    weights = smoothed_template_weights(cloud, fitted, model.kinds)
    assert_close(found.part_weight, weights, atol=1e-5, rtol=0)
