# SPDX-License-Identifier: MIT
"""Inliers: the views that a template is fitted to, each as it is placed most surely.

Of views of known objects those that stand as all of them do: single views look alike under turns
that differ from view to view, and of a cabinet two in five are upside down or on their side. An
object's frame is the same in all of its views (`objects`), so these vote for it; and objects that
are read together (`objects.agreeing`) stand alike, so what all views say counts more.

Where views of two sides of an object were taken for one side, its frame is wrong, and its cameras
gather. Where one half of it was taken for the other in some objects, cameras of all are spread more
widely than where they can be. So objects are asked together only where their cameras are spread
about as widely as those of single views are: of ovens, safes, drawers and scissors 0.91 to 1.12, of
baskets 0.78, of suitcases 0.73 and 1.15, of washers, on which views know better, about half, of
laptops 1.4 and 1.5. Nor do they vote together where a symmetry exchanges parts (`config.decided`),
and those of laptops and suitcases do not vote at all (`discovery`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.method import NO_JOURNAL, Journal, evenly
from scapo.records import take
from scapo.registered.bundle_adjustment import Candidate, Inliers
from scapo.registered.config import DiscoveryConfig
from scapo.registered.joint_limits import JointLimits
from scapo.registered.pairwise import within
from scapo.registered.pose_search import (
    NO_RIVAL,
    Hypotheses,
    SearchResult,
    best_of,
    most_confident,
    search_near,
    within_limits,
)
from scapo.registered.synchronisation import densest
from scapo.registered.views import PartialViews

VOTE = 30.0  # How sharply the losses of a view's hypotheses share its vote
AGREES = 25.0  # Degrees from the object's frame within which a hypothesis agrees with it
OF_ALL, NEAR = 31.0, 45.0
"""How much more a vote counts that is within so many degrees of what most views of all say."""
MORE = 0.3  # Share of the views that agree with others of their object, beyond that of bare views
SPREADS = 0.7, 1.2  # Variance of objects' cameras against single views' with which they are asked


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnedViews:
    """Views of several objects, each with its pose in a frame in which all objects stand alike."""

    views: PartialViews
    rotation: Float[Tensor, "B 3 3"]
    """view_R_common"""
    owner: Int[Tensor, " B"]
    """Which object a view shows."""
    variance: float
    """Of an object's cameras, the sum over their directions' coordinates; mean of the objects."""

    def spread(self, rotation: Float[Tensor, "B 3 3"]) -> float:
        """That variance against that of all views, each placed by itself.

        Args:
            rotation: view_R_template
        """
        cameras = (rotation.mT @ self.views.direction()[..., None])[..., 0]
        return self.variance / float(cameras.var(0).sum())

    def some(self, count: int, objects: int | None = None) -> OwnedViews:
        """So many views or all, spread evenly, of all objects or the first so many."""
        rows = torch.arange(len(self.owner))
        rows = rows if objects is None else rows[self.owner < objects]
        return take(self, rows[evenly(len(rows), count)])


Searched = PartialViews | OwnedViews


def voted(
    hypotheses: Hypotheses, limits: JointLimits, searched: OwnedViews, *, together: bool
) -> tuple[SearchResult, Bool[Tensor, " B"]]:
    """Of each view the hypothesis that its object's views vote for.

    Args:
        hypotheses: Of the views.
        limits: Of states.
        searched: The views.
        together: Whether what the views of all objects say is counted in.

    Returns:
        The placements, and whether a view has a hypothesis that agrees at all.
    """
    count, owner = len(searched.owner), searched.owner
    state = hypotheses.placement.state.unflatten(0, (count, -1))
    loss = hypotheses.loss + limits.penalty(state)
    frames = hypotheses.rotation().mT @ searched.rotation[:, None]  # template_R_common
    vote = torch.softmax(-VOTE * (loss + hypotheses.unlike), 1)
    if together and SPREADS[0] <= searched.spread(hypotheses.best_rotation()) <= SPREADS[1]:
        common, _ = densest(frames.flatten(0, 1), vote.flatten())
        vote = vote * (1 + OF_ALL * within((frames * common).sum((-1, -2)), NEAR))
    trace = torch.zeros_like(loss)  # With its object's frame
    for number in owner.unique():
        own = owner == number
        frame, _ = densest(frames[own].flatten(0, 1), vote[own].flatten())
        trace[own] = (frames[own] * frame).sum((-1, -2))
    agrees = within(trace, AGREES)
    unlike = hypotheses.unlike + NO_RIVAL * ~agrees
    return best_of(hypotheses.placement, loss, unlike), agrees.any(1)


def find_inliers(
    candidate: Candidate,
    searched: Searched,
    share: float,
    config: DiscoveryConfig,
    *,
    anywhere: bool = False,
    journal: Journal = NO_JOURNAL,
) -> Candidate:
    """The template with that share of the views as inliers, those that it explains best.

    Args:
        candidate: A template with its present inliers, whose states and cameras bound the search.
        searched: B views.
        share: Of them.
        config: Rotations, and the cost of a range of states.
        anywhere: Whether cameras are sought anywhere.
        journal: Of the training.
    """
    views = searched.views if isinstance(searched, OwnedViews) else searched
    hypotheses = search_near(candidate, views, anywhere=anywhere, journal=journal)
    found, limits = within_limits(candidate, hypotheses, config)
    if isinstance(searched, OwnedViews):
        found, agrees = voted(hypotheses, limits, searched, together=config.together)
        rows = agrees.nonzero()[:, 0]
        found, views, share = take(found, rows), take(views, rows), min(1.0, share + MORE)
    kept = most_confident(found, share)
    inliers = Inliers(views=take(views, kept), placement=take(found.placement, kept))
    return Candidate(template=candidate.template, inliers=inliers)
