# SPDX-License-Identifier: MIT
"""How objects stand in the template's frame, and what tells it of any view.

Views of one object are registered with one another; so all of them say together how it stands. The
hypotheses of single views leave a few ways open for each object, and the loss alone takes a wrong
one for objects that are less like the template. Two things know better that err elsewhere: how the
objects themselves agree (`objects.agreeing`: cameras, axes, which way parts lie), and what those
objects look like whose way is sure (`orientation`). Objects on which the loss and the objects agree
teach first; in each round more are added, those that are surest, each judged by a network that has
not seen it. Where the loss was right and objects look alike after a quarter turn, mistakes confirm
themselves; so objects teach only where views of those that a network has not seen then stand as
these do more often than by the loss alone.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
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
LOSS_VOTE, CONSENSUS = 3.0, 0.5
"""Nats that all hypotheses of an object are worth which agree with a way, and that a way is which
the objects' consensus takes."""
AGREED = 35.0  # Degrees from the consensus within which a way is the one that it takes
TAUGHT = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Share of the objects, the surest, that teach; the first where none agree."""
FOLDS = 3  # Parts of the objects, each judged by a network that learned from the others
LEAST_NATS = -4.0  # What a view can hold against a way at most
SURE_NATS = 9.0  # Lead of a way that has no rival
NEAR, LEAST_VOTE = 30.0, 0.1
"""Degrees from its object's way within which a hypothesis of a view says the same, and its vote
over that of the view's best one with which it may be so: other views were registered wrongly."""
LEAST_GAIN = 0.07
"""Share of the views that must come to stand as their objects do: drawers 0.09, washers 0.05."""


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
    turns = torch.stack([reading.turn for reading in agreeing(known, kinds)])
    taken = consensus(learner.ways, turns)
    prior = [
        LOSS_VOTE * way.share + CONSENSUS * own
        for way, own in zip(learner.ways, taken, strict=True)
    ]
    agreed = torch.tensor([bool(own[0] > 0) for own in taken])
    teach = agreed if int(agreed.sum()) >= LEAST_OBJECTS else surest(prior, TAUGHT[0])
    nats = prior
    for share in TAUGHT[1:]:
        judged = learner.judged([int(one.argmax()) for one in nats], teach)
        nats = [one + more for one, more in zip(prior, judged, strict=True)]
        teach = surest(nats, share)
    chosen = [int(one.argmax()) for one in nats]
    gain = learner.gain(chosen, teach)
    logger.info(
        "%d of %d objects agree how they stand; taught by them %+.1f %% of their views stand so",
        int(agreed.sum()), len(known), 100 * gain,
    )  # fmt: skip
    return learner.taught(chosen, teach) if gain >= LEAST_GAIN else None


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


def consensus(ways: Sequence[Ways], turns: Float[Tensor, "O 3 3"]) -> list[Float[Tensor, " _"]]:
    """1 for each way of an object that the consensus of the first O objects takes, 0 for others.

    Args:
        ways: Of all objects.
        turns: common_R_object of the first.
    """
    first = torch.stack([turn @ way.frame[0] for turn, way in zip(turns, ways, strict=False)])
    frame, _ = densest(first, torch.ones(len(first)))
    taken = [torch.zeros_like(way.share) for way in ways]
    for k, turn in enumerate(turns):
        trace = (turn @ ways[k].frame * frame).sum((-1, -2))
        taken[k] = within(trace, AGREED).to(trace)
    return taken


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
        self.loss = hypotheses.loss + hypotheses.unlike
        self.rotation = hypotheses.placement.rotation.unflatten(0, self.loss.shape)
        self.vote = torch.softmax(-VOTE * self.loss, 1)
        self.rows = [(owned.owner == k).nonzero()[:, 0] for k in range(int(owned.owner.max()) + 1)]
        self.ways = [
            ways_of(owned.rotation[own].mT[:, None] @ self.rotation[own], self.vote[own])
            for own in self.rows
        ]

    def taught(self, chosen: Sequence[int], teach: Bool[Tensor, " O"]) -> OrientationScorer:
        """The scorer after these objects with these ways."""
        shown = [self._standing(k, chosen[k]) for k in teach.nonzero()[:, 0].tolist()]
        rows, rotation = (torch.cat(found) for found in zip(*shown, strict=True))
        views = take(self.owned.views, rows)
        return OrientationScorer().learn(views, rotation, self.generator)

    @torch.no_grad()
    def judged(self, chosen: Sequence[int], teach: Bool[Tensor, " O"]) -> list[Float[Tensor, " _"]]:
        """Mean nats of each way of each object, by a scorer that learned from others."""
        nats = [torch.zeros_like(way.share) for way in self.ways]
        for held, scorer in self._held_out(chosen, teach):
            for k in held:
                frame = self.owned.rotation[self.rows[k]][:, None] @ self.ways[k].frame
                score = scorer(take(self.owned.views, self.rows[k]), frame)
                nats[k] = score.log_softmax(-1).clamp_min(LEAST_NATS).mean(0)
        return nats

    @torch.no_grad()
    def gain(self, chosen: Sequence[int], teach: Bool[Tensor, " O"]) -> float:
        """Share of views that come to stand as their objects by a scorer that learned from others.

        Less those that do no longer.
        """
        count = torch.zeros(())
        for held, scorer in self._held_out(chosen, teach):
            for k in held:
                rows = self.rows[k]
                near, loss = self._near(k, chosen[k]).float(), self.loss[rows]
                charged = loss + scorer.charge(take(self.owned.views, rows), self.rotation[rows])
                was, now = (near.gather(1, x.argmin(1, keepdim=True)) for x in (loss, charged))
                count += (now - was).sum()
        return float(count) / len(self.loss)

    def _held_out(
        self, chosen: Sequence[int], teach: Bool[Tensor, " O"]
    ) -> Iterator[tuple[list[int], OrientationScorer]]:
        """Objects in folds, and what the others taught a scorer."""
        order = torch.randperm(len(self.rows), generator=self.generator)
        for held in (order[k::FOLDS] for k in range(FOLDS)):
            others = teach.clone().index_fill(0, held, False)
            yield held.tolist(), self.taught(chosen, others if bool(others.any()) else teach)

    def _near(self, number: int, way: int) -> Bool[Tensor, "V F"]:
        """Which hypotheses of an object's views stand as the object does."""
        rows = self.rows[number]
        frame = self.owned.rotation[rows] @ self.ways[number].frame[way]
        return within((self.rotation[rows] * frame[:, None]).sum((-1, -2)), NEAR)

    def _standing(self, number: int, way: int) -> tuple[Int[Tensor, " V"], Float[Tensor, "V 3 3"]]:
        """Views of an object that may stand as it does, one at least, and their own turns then."""
        rows = self.rows[number]
        near = torch.where(self._near(number, way), self.vote[rows], 0.0)
        vote, best = near.max(1)
        relative = vote / self.vote[rows].amax(1)
        kept = relative >= relative.max().clamp_max(LEAST_VOTE)
        return rows[kept], self.rotation[rows, best][kept]
