# SPDX-License-Identifier: MIT
"""A side of the body that is missing is there again in its mirror image; parts stay alone."""

from __future__ import annotations

import pytest
import torch
from sighted import sighted, template
from strategies import generator

from scapo.discovery import completed, unexplained
from scapo.mirror import mirrored, thinned
from scapo.starts import DiscoveryConfig, Trusted
from scapo.template import ArticulatedTemplate


def without_a_side() -> ArticulatedTemplate:
    """The box with its flap, but without its side at positive y."""
    whole = template()
    with torch.no_grad():
        kept = (whole.normals[:, 1] < 0.8) | (whole.logit.argmax(-1) == 1)
        cut = ArticulatedTemplate(whole.kinds, int(kept.sum()))
        cut.assign(whole.points[kept], whole.normals[kept], whole.logit[kept])
        cut.axis.copy_(whole.axis)
        cut.pivot.copy_(whole.pivot)
    return cut


def test_the_base_is_mirrored_and_the_part_is_not() -> None:
    whole = template()
    added = mirrored(whole, 2)
    part = whole.logit.argmax(-1)
    assert len(added.points) == len(part) + int((part == 0).sum())
    assert (added.logit.argmax(-1) == 1).sum() == (part == 1).sum()
    image = added.points[len(part) :]
    assert torch.allclose(image[:, :2], whole.points[part == 0][:, :2])
    assert (image[:, 2].mean() + whole.points[part == 0][:, 2].mean()).abs() < 0.02
    assert torch.equal(added.normals[len(part) :, 2], -whole.normals[part == 0][:, 2])
    assert torch.equal(added.axis, whole.axis)


def test_thinned_keeps_the_parts() -> None:
    fewer = thinned(mirrored(template(), 0), 200)
    assert len(fewer.points) == 200
    assert 0.1 < (fewer.logit.argmax(-1) == 1).float().mean() < 0.7
    assert len(thinned(fewer, 400).points) == 200


@pytest.mark.slow
def test_a_missing_side_is_completed_where_views_ask_for_it() -> None:
    views, truth = sighted(12, seed=90)
    trusted, config = Trusted(views=views, placement=truth), DiscoveryConfig(rotations=300)
    cut = without_a_side()
    assert not (cut.normals[:, 1] > 0.8).any()
    found, after = completed((cut, trusted), views, views, config, generator(0))
    sideways = found.normals[found.logit.argmax(-1) == 0][:, 1]
    assert (sideways > 0.8).sum() > 10
    assert (sideways < -0.8).sum() > 10
    before = unexplained(cut, trusted, views, config, anywhere=True)
    assert unexplained(found, after, views, config) < before - 0.01
    whole = template(), trusted
    assert completed(whole, views, views, config, generator(0)) is whole
