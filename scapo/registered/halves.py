# SPDX-License-Identifier: MIT
"""Two halves that are alike: where neither part is the body, views meet in their middle.

Registration brings together what most of two views share, which is the body. The halves of scissors
or of a suitcase are equally large, and the frame in which most views agree is that between them: in
it each half has turned by half of the state, one this way and one that. Little of that motion is
left to be seen, and what is seen says nothing of what is one half (a blade and the handle across).

So every simple way to cut a shape in two about the axis is a start: lengthwise, across, or
crosswise, where opposite quarters are one half; with the views where they are (which is that middle
where two halves were taken for a body) and turned to the middle of what was found (where a half was
found well). Those that fit best are built anew and fitted in rounds, with no half favoured as the
base.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from scapo.geometry.points import ends
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.method import NO_JOURNAL, Journal, drawing, evenly
from scapo.records import take
from scapo.registered.bundle_adjustment import (
    BLUNT,
    FIRST_SEARCHED,
    FIRST_STEPS,
    SHARP,
    Candidate,
    FitOptions,
    Inliers,
    bundle_adjust,
    wide_states,
)
from scapo.registered.gauge import settle_hinges
from scapo.registered.motion_segmentation import rebuild
from scapo.registered.template import ArticulatedTemplate, Placement, across_axis
from scapo.registered.views import PartialViews

logger = logging.getLogger(__name__)

FITTED = 48  # Inliers, at most, that halves are fitted to
KEPT = (8, 4, 4, 3)
"""Cuts, those that fit best, that are kept after each round of fitting and building anew: which is
right shows late."""
PLACES = (0.35, 0.5, 0.65)  # Of the pivot along the shape, over its length
STATES = 25  # Tried of the hinge: 0.14 rad apart, half of which is left in the middle
LEAST_HALF, UNLIKE = 0.4, 0.053
"""Share of the smaller of two halves, and the largest `unlikeness` of two. Without a favoured base
any template explains views a little better: what differs from object to object goes to either part.
Of ovens' doors 0.31 to 0.42 come of it, with the ceiling in the end, and they are then 0.064 unlike
the body. Laptops, scissors and suitcases have 0.40 to 0.52 and 0.030 to 0.044."""
PLANES = 72  # Through the axis in which a half may be the other's mirror image
SURENESS = 6.0  # Logit of the half that a point begins in
SAME, MIRRORED = 0.8, 0.03
"""Share of the points that a mirror plane has to leave where they are, and how unlike halves may be
that it cuts: of suitcases 0.89 and 0.018, where boxes of safes may be cut through the hinge to 0.8
and 0.042."""
GAIN, WORTH = 0.1, 2.5
"""How much more alike a mirror plane has to make halves, as a share of how unlike they are: this,
and this for each point that it moves, as a share of all. Of suitcases with a strip too many 0.41
and 0.21 where 0.11 and 0.05 move; of laptops, whose base reaches beyond the hinge, 0.17 at most for
0.12; of good suitcases 0.04 for 0.01."""
ASIDE, PLACES_ASIDE, BORDER = 0.15, 31, 0.03
"""Normalised lengths: how far beside the hinge planes lie that are tried, of so many places; from
the plane to where a point is surely of one half."""


def may_have_halves(template: ArticulatedTemplate) -> bool:
    """Whether a template has two parts and a hinge between them."""
    return template.kinds == ("revolute",)


def are_halves(template: ArticulatedTemplate) -> bool:
    """Whether its two parts are about equally large, by their points, and alike."""
    share = float((template.logit.argmax(-1) == 1).float().mean())
    return LEAST_HALF <= share <= 1 - LEAST_HALF and unlikeness(template) <= UNLIKE


@torch.no_grad()
def unlikeness(template: ArticulatedTemplate) -> float:
    """Mean distance of two parts' points from the other part's mirror image in the best plane.

    Planes through the axis of the hinge, in normalised lengths. Of 400 points; fewer are farther.
    """
    seen, part = _seen_along(template), template.logit.argmax(-1)
    return min(_unlike(seen[part == 0], seen[part == 1], normal) for normal in _normals(seen))


def _seen_along(template: ArticulatedTemplate) -> Float[Tensor, "M 3"]:
    """Points from the hinge: two coordinates across its axis and one along it."""
    frame = torch.cat([across_axis(template.directions()[0]), template.directions()[:1]])
    return (template.points - template.pivot[0]) @ frame.T


def _normals(like: Tensor) -> Float[Tensor, "K 3"]:
    """Of planes along the third direction."""
    turn = torch.pi / PLANES * torch.arange(PLANES).to(like)
    return torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], -1)


def _unlike(
    one: Float[Tensor, "K 3"], other: Float[Tensor, "L 3"], normal: Tensor, place: float = 0.0
) -> float:
    """Mean distance, both ways, of one half from the other's mirror image in a plane."""
    image = other - 2 * (other @ normal - place)[:, None] * normal
    apart = torch.cdist(one, image)
    return float(apart.amin(0).mean() + apart.amin(1).mean()) / 2


@torch.no_grad()
def cut_by_mirror(template: ArticulatedTemplate, placement: Placement) -> Placement:
    """Cut two like halves by the plane in which they mirror each other, in place, if one does.

    Two shells that meet at a hinge lie on either side of a plane through it, at any state. But near
    the hinge a part moves little: of suitcases a strip of one shell went to the other, with the
    hinge at its far end. The plane along the axis in which the points on either side are mirror
    images says it better. It has to make two halves that are much alike, clearly more so than the
    parts as they are, the more points it moves, and to leave most where they are: halves of
    scissors cross each other, the base of a laptop reaches beyond its hinge. How large the parts
    were says nothing: strips left 0.38 to one half of suitcases.

    Args:
        template: With a hinge and two parts; others stay as they are.
        placement: Of the views that it was fitted to.

    Returns:
        The same motions as turns about the new hinge, which is where the halves touch, with the
        shifts that are left: those that were found are small about the old one, by which they were
        priced.
    """
    if not may_have_halves(template):
        return placement
    seen, part = _seen_along(template), template.logit.argmax(-1)
    best, moved, found = MIRRORED, 0.0, None
    for normal in _normals(seen):
        for place in torch.linspace(-ASIDE, ASIDE, PLACES_ASIDE).tolist():
            beyond = seen @ normal > place
            share = float(beyond.float().mean())
            same = float((beyond == (part == 1)).float().mean())
            stay = max(same, 1 - same)
            if stay < SAME or not LEAST_HALF <= share <= 1 - LEAST_HALF:
                continue
            unlike = _unlike(seen[~beyond], seen[beyond], normal, place)
            if unlike < best:
                best, moved = unlike, 1 - stay
                found = (normal, place) if same > 0.5 else (-normal, -place)
    if found is None or best >= (1 - max(GAIN, WORTH * moved)) * unlikeness(template):
        return placement
    normal, place = found
    side = ((seen @ normal - place) / BORDER).clamp(-1, 1) * SURENESS / 2
    template.logit.copy_(torch.stack([-side, side], -1))
    logger.info("two halves cut by their mirror plane: %.3f beside the hinge", abs(place))
    return settle_hinges(template, placement, touching=True)


def in_halves(
    candidate: Candidate,
    generator: torch.Generator,
    journal: Journal = NO_JOURNAL,
) -> list[Candidate]:
    """Templates of two like halves on some of the candidate's inliers, those that fit best.

    Args:
        candidate: With one hinge (`may_have_halves`); it stays as it is.
        generator: Draws points.
        journal: Of the training.
    """
    template = candidate.template
    some = evenly(len(candidate.inliers.views.points), FITTED)
    inliers = take(candidate.inliers, some)
    views, placement = inliers.views, inliers.placement
    starts = (at_rest(placement), to_the_middle(template, placement))
    fits = [_Fit(cut, start) for start in starts for cut in cuts(template)]
    for number, kept in enumerate(KEPT):
        jobs = drawing(partial(_round, number=number), fits, (views,), generator)
        fits = [job() for job in journal.ahead(jobs)]
        fits = sorted(fits, key=lambda fit: fit.loss)[:kept]
        logger.info("cuts in two fitted: %s", " ".join(f"{fit.loss:.4f}" for fit in fits))
    return [
        Candidate(template=fit.template, inliers=Inliers(views=views, placement=fit.placement))
        for fit in fits
    ]


def at_rest(placement: Placement) -> Placement:
    """Where the bases are, with states and shifts of zero."""
    return replace(
        placement,
        state=torch.zeros_like(placement.state),
        shift=torch.zeros_like(placement.shift),
    )


@torch.no_grad()
def to_the_middle(template: ArticulatedTemplate, placement: Placement) -> Placement:
    """The frames half way between base and part, with states and shifts of zero."""
    turn = rotvec_to_rotmat(template.directions()[0] * placement.state / 2)
    pivot = template.pivot[0] * placement.log_scale.exp()
    move = pivot - (turn @ pivot[..., None])[..., 0] + placement.shift[:, 0] / 2
    return replace(
        at_rest(placement),
        rotation=placement.rotation @ turn,
        translation=placement.translation + (placement.rotation @ move[..., None])[..., 0],
    )


@torch.no_grad()
def cuts(template: ArticulatedTemplate) -> list[ArticulatedTemplate]:
    """The template's points in two halves: lengthwise, across at each place, crosswise there.

    Lengths are seen along the axis, of which the direction stays; the pivot is where the cuts meet.
    """
    across = across_axis(template.directions()[0])
    seen = template.points @ across.T
    middle = ends(seen).mean(0)
    length = torch.linalg.svd(seen - middle, full_matrices=False).Vh
    along, aside = ((seen - middle) @ length.T).unbind(-1)
    low, high = ends(along)
    made = [_cut(template, aside > 0, middle @ across)]
    for place in PLACES:
        met = low + place * (high - low)
        pivot = (middle + met * length[0]) @ across
        halves = (along > met, (along > met) == (aside > 0))
        made += [_cut(template, half, pivot) for half in halves]
    return made


def _cut(template: ArticulatedTemplate, half: Tensor, pivot: Tensor) -> ArticulatedTemplate:
    made = template.with_points(len(half))
    made.logit.copy_(SURENESS * F.one_hot(half.long(), 2))
    made.pivot[0] = pivot
    made.alike.fill_(1.0)
    return made


@dataclass(frozen=True, slots=True)
class _Fit:
    template: ArticulatedTemplate
    placement: Placement
    loss: float = torch.inf


def _round(fit: _Fit, views: PartialViews, generator: torch.Generator, *, number: int) -> _Fit:
    """Fitted, and built anew; the template changes in place."""
    template, states = fit.template, wide_states(fit.template.kinds, STATES)
    options = FitOptions(
        steps=FIRST_STEPS,
        sharpness=SHARP if number else BLUNT,
        search_states=FIRST_SEARCHED if number < len(KEPT) // 2 else (),
    )
    placement, loss = bundle_adjust(
        template, views, fit.placement, options, states=states, generator=generator
    )
    placement = settle_hinges(template, placement)
    rebuild(template, views, placement, generator=generator)
    return _Fit(template, placement, float(loss.mean()))
