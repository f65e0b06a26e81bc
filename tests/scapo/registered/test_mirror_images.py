# SPDX-License-Identifier: MIT
"""Mirror images of bases and of parts lie where they should."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scapo.categories import JointKind
from scapo.registered.bundle_adjustment import Candidate, Inliers
from scapo.registered.mirror_images import mirrored, paired
from scapo.registered.template import ArticulatedTemplate, Placement
from tests.helpers.sighted import sighted, without_a_side
from tests.helpers.strategies import generator


def test_the_base_is_mirrored_and_the_part_is_not() -> None:
    cut = without_a_side()
    part, none = cut.logit.argmax(-1), cut.normals[:, 1] > 0.8
    assert not (none & (part == 0)).any()
    whole = mirrored(cut, 1)
    assert len(whole.points) == len(cut.points)
    base = whole.logit.argmax(-1) == 0
    right = base & (whole.normals[:, 1] > 0.8)
    left = base & (whole.normals[:, 1] < -0.8)
    assert right.sum() > 0.6 * left.sum() > 10
    middle = (whole.points[right, 1].mean() + whole.points[left, 1].mean()) / 2
    assert middle.abs() < 0.02
    flap, before = whole.points[~base], cut.points[part == 1]
    assert (flap[:, None] - before).norm(dim=-1).amin(1).max() < 1e-6
    assert torch.equal(whole.axis, cut.axis)
    assert torch.equal(whole.pivot, cut.pivot)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("joint", [0, 1])
def test_one_part_is_mirrored_in_place_of_the_other(joint: int, kind: JointKind) -> None:
    """Opened as far, the two lie as each other's mirror images; the other itself is gone."""
    g, other = generator(3), 1 - joint
    base = torch.rand(80, 3, generator=g) * torch.tensor([0.4, 0.6, 0.3])
    lid = torch.rand(40, 3, generator=g) * torch.tensor([0.4, 0.1, 0.02]) + 0.3
    rest = torch.rand(60, 3, generator=g)
    shape = ArticulatedTemplate((kind, kind), 180)
    part = torch.tensor([0, joint + 1, other + 1]).repeat_interleave(torch.tensor([80, 40, 60]))
    normals = torch.nn.functional.normalize(torch.randn(180, 3, generator=g), dim=-1)
    shape.assign(torch.cat([base, lid, rest]), normals, 9.0 * torch.eye(3)[part])
    with torch.no_grad():
        shape.axis[joint] = torch.tensor([0.9, 0.1, 0.3])
        shape.pivot[joint] = torch.tensor([0.1, 0.5, 0.2])
    still = Placement.at(torch.eye(3).expand(4, 3, 3), torch.zeros(4, 3), torch.zeros(4, 2))
    views, _ = sighted(4, seed=3)
    found = paired(
        Candidate(template=shape, inliers=Inliers(views=views, placement=still)), joint, 1
    )
    made = found.template
    placed, facing = made.place(replace(still, state=torch.full((4, 2), 0.7)))
    of = made.logit.argmax(-1)
    middle = base[:, 1].quantile(torch.tensor([0.02, 0.98])).mean()
    mirror = torch.tensor([1.0, -1.0, 1.0])
    first, second = placed[0, of == joint + 1], placed[0, of == other + 1]
    assert len(second) >= 30
    image = second * mirror + torch.tensor([0.0, 2.0, 0.0]) * middle
    apart, nearest = (image[:, None] - first).norm(dim=-1).min(1)
    assert apart.max() < 1e-5
    turned = facing[0, of == joint + 1][nearest]
    assert torch.allclose(facing[0, of == other + 1] * mirror, turned, atol=1e-4)
    assert torch.equal(found.inliers.placement.state, still.state)
