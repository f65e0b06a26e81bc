# SPDX-License-Identifier: MIT
"""What tells of any view how it stands in the template's frame, learned from objects.

The hypotheses of single views leave a few ways open, and the loss alone takes a wrong one for
objects that are less like the template. Views of one object, registered with one another, know
better: where its cameras were, the axes of its joints and which way its parts lie say how the
object is turned against the others (`objects.agreeing`), and no template is asked. What those
objects look like then tells single views of others (`orientation`).

Where views of two sides of an object were taken for one side, its frame is wrong, and its cameras
gather. So objects teach only where their cameras are spread nearly as widely as those of single
views are: of ovens, safes and drawers 0.96 to 1.08, of suitcases 0.73, of washers, on which views
know better, about half.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch

from scapo.categories import JointKind
from scapo.records import cat
from scapo.registered.objects import OneObject, agreeing
from scapo.registered.orientation import OrientationScorer
from scapo.registered.pose_search import Hypotheses, OwnedViews
from scapo.registered.synchronisation import densest

logger = logging.getLogger(__name__)

ASKED = 96  # Views of objects that tell how the template is turned against them
LEAST_SPREAD = 0.7  # Variance of an object's cameras against single views' with which objects teach


def taught_by_objects(
    known: Sequence[OneObject],
    kinds: tuple[JointKind, ...],
    asked: OwnedViews,
    hypotheses: Hypotheses,
    generator: torch.Generator,
) -> OrientationScorer | None:
    """A scorer that learned from how the objects stand; None where they know no better than views.

    Args:
        known: The objects.
        kinds: Of their joints.
        asked: Some of their views.
        hypotheses: Of these, in the template's frame.
        generator: On the host.
    """
    loss = hypotheses.loss + hypotheses.unlike
    rotation = hypotheses.placement.rotation.unflatten(0, loss.shape)
    alone = rotation[torch.arange(len(loss)), loss.argmin(1)]  # view_R_template
    cameras = (alone.mT @ asked.views.direction()[..., None])[..., 0]
    own = torch.stack([one.cameras().var(0).sum() for one in known]).mean()
    spread = float(own / cameras.var(0).sum())
    logger.info("cameras of objects spread %.2f as widely as those of single views", spread)
    if spread < LEAST_SPREAD:
        return None
    turns = torch.stack([reading.turn for reading in agreeing(known, kinds)])
    common = turns[asked.owner] @ asked.rotation.mT @ alone  # common_R_template, by each view
    frame = densest(common, torch.ones(len(common)))[0]
    views = cat([one.posed.views for one in known])
    stands = torch.cat(
        [one.posed.rotation @ turn.mT @ frame for one, turn in zip(known, turns, strict=True)]
    )
    return OrientationScorer().learn(views, stands, generator)
