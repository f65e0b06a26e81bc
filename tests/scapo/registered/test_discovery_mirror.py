# SPDX-License-Identifier: MIT
"""A side of the body that is missing is there again in its mirror image; parts stay alone."""

from __future__ import annotations

import pytest
import torch

from scapo.registered.discovery import completed, detailed, mirrored
from scapo.registered.initialisation import DiscoveryConfig, Trusted
from scapo.registered.template import ArticulatedTemplate
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator


def without_a_side() -> ArticulatedTemplate:
    """The box with its flap, but without its side at positive y."""
    whole = template(count=500)
    kept = (whole.normals[:, 1] < 0.8) | (whole.logit.argmax(-1) == 1)
    cut = whole.with_points(400)
    cut.assign(whole.points[kept][:400], whole.normals[kept][:400], whole.logit[kept][:400])
    return cut


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


@pytest.mark.slow
def test_a_side_that_trusted_views_never_saw_is_there_after_a_round(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO", "scapo.registered.discovery")
    views, truth = sighted(28, seed=91)
    config = DiscoveryConfig(rotations=300, trusted=(0.8,))
    left = Trusted(views=views, placement=truth).cameras()[:, 1] < -0.1
    seen = left.nonzero()[:, 0]
    trusted = Trusted(views=views.take(seen), placement=truth.take(seen))
    found, after = completed((without_a_side(), trusted), views, views, config, generator(0))
    assert "kept: 2" in caplog.text  # 0 as it was, then its image along x, y, z
    base = found.logit.argmax(-1) == 0
    assert (found.normals[base, 1] > 0.8).sum() > 15
    assert (found.normals[base, 1] < -0.8).sum() > 15
    dense, _ = detailed((found, after), config, generator(0))
    assert len(dense.points) == config.final_points
