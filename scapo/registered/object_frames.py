# SPDX-License-Identifier: MIT
"""What tells of any view how it stands in the template's frame, learned from objects.

The hypotheses of single views leave a few ways open, and the loss alone takes a wrong one for
objects that are less like the template. Views of one object, registered with one another, know
better: where its cameras were, the axes of its joints and which way its parts lie say how the
object is turned against the others (`objects.agreeing`), and no template is asked. What those
objects look like then tells single views of others (`orientation`). Where views know as well
(`inliers`), objects do not teach.
"""

from __future__ import annotations

import logging

import torch

from scapo.registered.inliers import SPREADS, OwnedViews
from scapo.registered.orientation import OrientationScorer
from scapo.registered.pose_search import Hypotheses
from scapo.registered.synchronisation import densest

logger = logging.getLogger(__name__)

ASKED = 96  # Views of objects that tell how the template is turned against them


def taught_by_objects(
    known: OwnedViews, asked: OwnedViews, hypotheses: Hypotheses, generator: torch.Generator
) -> OrientationScorer | None:
    """A scorer that learned from how the objects stand; None where they know no better than views.

    Args:
        known: Views of objects, which are learned from.
        asked: Some of them.
        hypotheses: Of these, in the template's frame.
        generator: On the host.
    """
    alone = hypotheses.best_rotation()
    spread = asked.spread(alone)
    logger.info("cameras of objects spread %.2f as widely as those of single views", spread)
    if not SPREADS[0] <= spread <= SPREADS[1]:
        return None
    common = asked.rotation.mT @ alone  # common_R_template, by each view
    frame = densest(common, torch.ones(len(common)))[0]
    return OrientationScorer().learn(known.views, known.rotation @ frame, generator)
