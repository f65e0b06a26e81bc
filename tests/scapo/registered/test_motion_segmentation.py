# SPDX-License-Identifier: MIT
"""Parts from motion: points get the part whose motion other views confirm."""

from __future__ import annotations

from dataclasses import replace

import torch

from scapo.registered.motion_segmentation import (
    LEAST_BONUS,
    favouring_base,
    gather_evidence,
    in_one_piece,
    rebuild,
    smooth,
)
from scapo.registered.template import Placement
from scapo.registered.view_loss import oriented_nearest
from scapo.registered.views import PartialViews
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator


def true_parts(views: PartialViews, truth: Placement) -> torch.Tensor:
    """Of the views' points, from the true template."""
    shape = template(seed=3, count=2000)
    index = oriented_nearest(views.points, views.normals, *shape.place(truth))
    return shape.logit.argmax(-1)[index]


@torch.no_grad()
def test_evidence_tells_the_parts():
    views, truth = sighted(10, seed=20)
    shape = template()
    evidence = gather_evidence(
        views, shape.part_poses(truth), truth.log_scale, count=96, observers=torch.arange(10)
    )
    score = smooth(views, evidence.log_support - evidence.log_support.mean(-1, keepdim=True))
    correct = score.argmax(-1) == true_parts(views, truth)[:, :96]
    assert correct.float().mean() > 0.85


@torch.no_grad()
def test_views_of_few_points_give_all_of_them():
    views, truth = sighted(3, seed=20)
    there = views.points.shape[1]
    some, every = (
        gather_evidence(
            views, template().part_poses(truth), truth.log_scale,
            count=count, observers=torch.arange(3),
        )
        for count in (there, there + 1)
    )  # fmt: skip
    assert every.seen.shape[1] == there
    torch.testing.assert_close(some.log_support, every.log_support)


def test_smoothing_keeps_a_constant():
    views, _ = sighted(2, seed=21)
    assert torch.allclose(smooth(views, torch.full((2, 64, 2), 0.7)), torch.tensor(0.7), atol=1e-4)


@torch.no_grad()
def test_the_template_is_rebuilt_from_the_views():
    views, truth = sighted(12, seed=22)
    shape = template()
    shape.points.data += 0.05 * torch.randn(400, 3, generator=generator(1))
    shape.logit.zero_()
    rebuild(shape, views, truth, generator=generator(2))
    good = template(seed=5, count=3000)
    off, index = torch.cdist(shape.points, good.points).min(-1)
    assert off.quantile(0.9) < 0.04
    parts = shape.logit.argmax(-1) == good.logit.argmax(-1)[index]
    assert parts.float().mean() > 0.8


@torch.no_grad()
def test_settled_placements_tell_what_lies_near_a_hinge():
    """It moves little, and is left to the base as long as placements are not sure."""
    views, truth = sighted(16, seed=22)
    good = template(seed=5, count=3000)
    of_part = good.logit.argmax(-1) == 1
    gap = good.points - good.pivot[0]
    away = (gap - (gap @ good.directions().T) * good.directions()).norm(dim=1)
    strip = of_part & (away < 0.3 * away[of_part].max())
    kept = []
    for settled in (False, True):
        shape = template()
        rebuild(shape, views, truth, settled=settled, generator=generator(2))
        index = torch.cdist(good.points[strip], shape.points).argmin(1)
        kept.append(float((shape.logit.argmax(-1)[index] == 1).float().mean()))
    assert kept[1] > kept[0] + 0.05


@torch.no_grad()
def test_what_only_flaps_leave_there_is_no_surface_of_the_base():
    """A view that is placed with a wrong state takes its flap for the base's; others' are there."""
    views, truth = sighted(24, seed=22)
    state = truth.state.clone()
    state[::4] = 0.0
    wrong = replace(truth, state=state)
    good = template(seed=5, count=3000)
    base = good.points[good.logit.argmax(-1) == 0]
    strays = []
    for settled in (False, True):
        shape = template()
        rebuild(shape, views, wrong, settled=settled, generator=generator(2))
        own = shape.points[shape.logit.argmax(-1) == 0]
        strays.append(int((torch.cdist(own, base).amin(1) > 0.06).sum()))
    assert strays[1] < strays[0] / 2


def test_a_part_is_one_piece():
    g = generator(3)
    flap = torch.rand(80, 3, generator=g) * torch.tensor([0.3, 0.3, 0.01])
    wall = torch.rand(30, 3, generator=g) * torch.tensor([0.2, 0.01, 0.2]) + torch.tensor([1, 1, 1])
    body = torch.rand(90, 3, generator=g) * 0.4 + torch.tensor([0.0, 0.0, 0.5])
    logit = torch.tensor([0.0, 4.0]).repeat(200, 1)
    logit[110:] = torch.tensor([4.0, 0.0])
    part = in_one_piece(torch.cat([flap, wall, body]), logit).argmax(-1)
    assert part.tolist() == [1] * 80 + [0] * 120
    assert logit.argmax(-1).tolist() == [1] * 110 + [0] * 90


def test_what_nothing_tells_apart_stays_with_the_base():
    score = torch.zeros(1, 100, 2)
    score[0, :40, 1] = 0.2  # a little for the part: more than the least bonus, less than the usual
    score[0, :20, 1] = 1.0
    assert (favouring_base(score).argmax(-1) == 1).sum() == 20
    assert (favouring_base(score, LEAST_BONUS).argmax(-1) == 1).sum() == 40
    score[0, :20, 1] = 0.2  # the usual bonus would leave it nothing
    assert (favouring_base(score).argmax(-1) == 1).sum() == 40
