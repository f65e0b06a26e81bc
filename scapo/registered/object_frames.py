# SPDX-License-Identifier: MIT
"""How objects stand in the template's frame, and what tells it of any view.

Views of one object are registered with one another; so all of them say together how it stands. The
hypotheses of single views leave a few ways open for each object, and the loss alone takes a wrong
one for objects that are less like the template. Two things know better: how the objects themselves
agree (`objects.agreeing`: cameras, axes, which way parts lie), and what those objects look like
whose way is sure (`orientation`). The objects on which all agree teach first; in each round others
do, the surest, each judged by a network that has not seen it.

Where views of two sides of an object were taken for one side, its frame is wrong, and its cameras
gather. So objects teach only where their cameras are spread nearly as widely as those of single
views are: of drawers 0.87, of washers, on which views know better, 0.47.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from scapo.categories import JointKind
from scapo.records import cat, take
from scapo.registered.joint_proposals import PosedViews
from scapo.registered.objects import LEAST_OBJECTS, OneObject, agreeing
from scapo.registered.orientation import OrientationScorer
from scapo.registered.pairwise import within
from scapo.registered.pose_search import AGREES, VOTE, Hypotheses, OwnedViews
from scapo.registered.synchronisation import densest

logger = logging.getLogger(__name__)

WAYS, ASIDE = 8, 40.0
"""Ways of an object that are told apart at most, and the degrees between them at least."""
LOSS_VOTE, CONSENSUS = 0.5, 1.0
"""Nats that all hypotheses of an object are worth which agree with a way, and that a way is which
the objects' consensus takes."""
AGREED = 35.0  # Degrees from the consensus within which a way is the one that it takes
TAUGHT = (0.5, 0.7, 0.9)  # Share of the objects, the surest, that teach after each round
FOLDS = 3  # Parts of the objects, each judged by a network that learned from the others
LEAST_NATS = -4.0  # What a view can hold against a way at most
SURE_NATS = 9.0  # Lead of a way that has no rival
LEAST_SPREAD = 0.7  # Variance of an object's cameras against single views' with which objects teach


@dataclass(frozen=True, slots=True, kw_only=True)
class Ways:
    """Ways in which one object may stand."""

    frame: Float[Tensor, "M 3 3"]
    """object_R_template"""
    share: Float[Tensor, " M"]
    """Of its views' hypotheses that agree with each."""


def all_views(posed: Sequence[PosedViews]) -> OwnedViews:
    """The views of all objects."""
    owner = [torch.full((len(one.rotation),), k) for k, one in enumerate(posed)]
    return OwnedViews(
        views=cat([one.views for one in posed]),
        rotation=torch.cat([one.rotation for one in posed]),
        owner=torch.cat(owner),
    )


def taught_by_objects(
    known: Sequence[OneObject],
    kinds: tuple[JointKind, ...],
    owned: OwnedViews,
    hypotheses: Hypotheses,
    generator: torch.Generator,
) -> OrientationScorer | None:
    """A scorer that learned from how the objects stand; None where they know no better than views.

    Args:
        known: The first of the objects, whose joints are known too.
        kinds: Of the joints.
        owned: Views of all objects.
        hypotheses: Of these views.
        generator: On the host.
    """
    learner = _Learner(owned, hypotheses, generator)
    spread = learner.spread()
    logger.info("cameras of objects spread %.2f as widely as those of single views", spread)
    if spread < LEAST_SPREAD:
        return None
    turns = torch.stack([reading.turn for reading in agreeing(known, kinds)])
    learner.ways, taken = read_alike(learner.ways, turns)
    prior = [
        LOSS_VOTE * way.share + CONSENSUS * own
        for way, own in zip(learner.ways, taken, strict=True)
    ]
    nats, teach = prior, torch.tensor([bool(own.any()) for own in taken])
    for share in TAUGHT:
        judged = learner.judged(nats, teach)
        nats = [one + more for one, more in zip(prior, judged, strict=True)]
        teach = surest(nats, share)
    return learner.taught(nats, teach)


@torch.no_grad()
def ways_of(frames: Float[Tensor, "V F 3 3"], vote: Float[Tensor, "V F"]) -> Ways:
    """The ways on which most hypotheses of an object's views agree, the first the most.

    Args:
        frames: object_R_template by each hypothesis.
        vote: Of each, 1 for each view.
    """
    every, each = frames.flatten(0, 1), vote.flatten() / len(vote)
    found, shares, left = list[Tensor](), list[Tensor](), each
    while len(found) < WAYS and bool((left > 0).any()):
        frame, _ = densest(every, left)
        trace = (every * frame).sum((-1, -2))
        found.append(frame)
        shares.append(each[within(trace, AGREES)].sum())
        left = left * ~within(trace, ASIDE)
    order = torch.stack(shares).argsort(descending=True, stable=True)
    return Ways(frame=torch.stack(found)[order], share=torch.stack(shares)[order])


def read_alike(
    ways: Sequence[Ways], turns: Float[Tensor, "O 3 3"]
) -> tuple[list[Ways], list[Float[Tensor, " _"]]]:
    """The ways, and 1 for each that the consensus of the first O objects takes, 0 for others.

    Of those objects that have no such way it is added.

    Args:
        ways: Of all objects.
        turns: common_R_object of the first.
    """
    first = torch.stack([turn @ way.frame[0] for turn, way in zip(turns, ways, strict=False)])
    frame, _ = densest(first, torch.ones(len(first)))
    every, taken = list(ways), [torch.zeros_like(way.share) for way in ways]
    for k, wanted in enumerate(turns.mT @ frame):
        near = within((every[k].frame * wanted).sum((-1, -2)), AGREED)
        if not bool(near.any()):
            more = Ways(frame=wanted[None], share=torch.zeros(1))
            every[k], near = cat([every[k], more]), F.pad(near, (0, 1), value=True)
        taken[k] = near.float()
    return every, taken


def surest(nats: Sequence[Float[Tensor, " _"]], share: float) -> Bool[Tensor, " O"]:
    """That share of the objects, those whose best way leads the most."""
    lead = []
    for one in nats:
        best = one.sort(descending=True).values
        lead.append(float(best[0] - best[1]) if len(best) > 1 else SURE_NATS)
    count = max(LEAST_OBJECTS, round(share * len(lead)))
    kept = torch.tensor(lead).argsort(descending=True, stable=True)[:count]
    return torch.zeros(len(lead), dtype=torch.bool).index_fill(0, kept, True)


class _Learner:
    """Learns from objects whose way is taken, and judges the ways of others."""

    def __init__(
        self, owned: OwnedViews, hypotheses: Hypotheses, generator: torch.Generator
    ) -> None:
        self.owned, self.generator = owned, generator
        loss = hypotheses.loss + hypotheses.unlike
        rotation = hypotheses.placement.rotation.unflatten(0, loss.shape)
        vote = torch.softmax(-VOTE * loss, 1)
        best = torch.gather(rotation, 1, loss.argmin(1)[:, None, None, None].expand(-1, 1, 3, 3))
        self.alone = best[:, 0]
        """view_R_template of single views."""
        self.rows = [(owned.owner == k).nonzero()[:, 0] for k in range(int(owned.owner.max()) + 1)]
        self.ways = [
            ways_of(owned.rotation[own].mT[:, None] @ rotation[own], vote[own]) for own in self.rows
        ]

    def spread(self) -> float:
        """Variance of cameras about their objects, against that of single views."""
        direction = self.owned.views.direction()[..., None]
        alone = (self.alone.mT @ direction)[..., 0].var(0).sum()
        about = (self.owned.rotation.mT @ direction)[..., 0]
        own = torch.stack([about[rows].var(0).sum() for rows in self.rows])
        return float(own.mean() / alone)

    def taught(
        self, nats: Sequence[Float[Tensor, " _"]], teach: Bool[Tensor, " O"]
    ) -> OrientationScorer:
        """The scorer after these objects, which stand in the likeliest of their ways."""
        way = [own.frame[one.argmax()] for own, one in zip(self.ways, nats, strict=True)]
        rotation = self.owned.rotation @ torch.stack(way)[self.owned.owner]
        rows = teach[self.owned.owner].nonzero()[:, 0]
        views = take(self.owned.views, rows)
        return OrientationScorer().learn(views, rotation[rows], self.generator)

    @torch.no_grad()
    def judged(
        self, nats: Sequence[Float[Tensor, " _"]], teach: Bool[Tensor, " O"]
    ) -> list[Float[Tensor, " _"]]:
        """Mean nats of each way of each object, by a scorer that learned from others."""
        order, found = torch.randperm(len(teach), generator=self.generator), list(nats)
        for held in (order[k::FOLDS] for k in range(FOLDS)):
            others = teach.index_fill(0, held, False)
            scorer = self.taught(nats, others if bool(others.any()) else teach)
            for k in held.tolist():
                frame = self.owned.rotation[self.rows[k]][:, None] @ self.ways[k].frame
                score = scorer(take(self.owned.views, self.rows[k]), frame)
                found[k] = score.log_softmax(-1).clamp_min(LEAST_NATS).mean(0)
        return found
