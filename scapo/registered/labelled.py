# SPDX-License-Identifier: MIT
"""A bound: the search of `method` with a template built from true placements, all labels used.

What one template per category can explain at best limits the registration method beside what
discovery gets wrong. Here nothing is discovered. True part poses bring the points of the training
clouds to rest, in their object's frame; each object is scaled along that frame's axes until its box
at rest is the template's; where a sliding part sits on the body is taken out too. There the points
that most clouds share make the template, their parts and joints as labelled. Network, search and
refinement are those of `registered`; the network learns what the search finds. Axes do not deviate.

As poses were seen in training, predicted part frames are the true ones: those of the object at
rest.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.points import Similarity, ends, nearest
from scapo.geometry.rigid import apply, invert
from scapo.method import changes
from scapo.ranges import Share
from scapo.records import map_tensors, take
from scapo.registered.base import AbstractRegistered
from scapo.registered.config import UNNAMED, SearchConfig
from scapo.registered.discovery import Discovery
from scapo.registered.pose_refinement import RANKED, backward_weight
from scapo.registered.pose_search import SearchResult
from scapo.registered.pseudo_labels import LearnedClouds
from scapo.registered.template import (
    ArticulatedTemplate,
    Placement,
    spread_out,
    surface_features,
)
from scapo.registered.view_loss import view_loss
from scapo.registered.views import PartialViews
from scapo.types import FullyLabelled, Labels, Observation, Supervision

logger = logging.getLogger(__name__)

LEAST_COUNT, ALL_COUNT = 40, 24000
"""Points of a view that the template is built from, at least, and of all views together."""
COUNTED = 4  # Of those, one in so many is asked whether it has the same surface
SHARED = 0.03  # Reach (of `surface_features`) within which surface is the same, and is averaged
LEFT_OUT = 0.2
"""Share of each part's points that enter no template: those with the least of the same surface."""
LEAST_SHARE = 1e-3  # Of a part in a template point, so that its logit is finite
SECONDS = 0.05  # Of one core for each learned cloud
CHUNK = 64  # Views, and as many times 16 points, that are compared at once


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelledConfig(SearchConfig):
    """A bound: template registration with the template of true placements, all labels."""

    trusted: Share = 1.0
    """Share of the learned clouds, those that the template explains best, that tell states, cameras
    and looks, all true, and of the placed ones from which the network learns."""


class LabelledRegistered(AbstractRegistered):
    """What the search can do with one template: the template is built from all labels."""

    name: ClassVar[str] = "registered-labelled"
    supervision: frozenset[Supervision] = frozenset({"segmentation", "pose", "joint", "instance"})

    @property
    def variant(self) -> str:
        """Options that differ from the default, but for how much is trained."""
        return " ".join(changes(self.config, LabelledConfig(), leave=UNNAMED))

    def _seconds(self, clouds: int) -> float:
        """Of the template and the losses of true placements."""
        return SECONDS * clouds

    def _found(
        self,
        learned: LearnedClouds,
        observation: Observation,
        labels: Labels,
        generator: torch.Generator,
    ) -> Discovery:
        """By the labels.

        Raises:
            ValueError: Some are withheld.
        """
        del generator
        clouds = FullyLabelled.of(observation, labels, self.name)
        clouds = map_tensors(clouds, lambda tensor: tensor.cpu())
        made = labelled_template(learned, clouds, self.template.kinds, len(self.template.points))
        logger.info("template of true placements: mean loss %.3f", float(made.found.loss.mean()))
        return made

    def _rest(self, placement: Placement) -> Float[Tensor, "B J"]:
        """The template's own: it is the mean of the objects as they are made, and stretches so."""
        return self.template.rest.expand_as(placement.state)

    def _origin(self) -> Float[Tensor, " 3"]:
        """Part frames are the object's at rest, and so is the template's."""
        return torch.zeros_like(self.template.points[0])


@torch.no_grad()
def labelled_template(
    learned: LearnedClouds, clouds: FullyLabelled, kinds: tuple[JointKind, ...], count: int
) -> Discovery:
    """The template of true placements, and those of the learned clouds.

    Args:
        learned: Their views and normalisation.
        clouds: All training clouds; boxes are told from all clouds of an object.
        kinds: Of the joints.
        count: Points of the template.
    """
    template = ArticulatedTemplate(kinds, count)
    extent, centre = (box[learned.index] for box in rest_boxes(clouds))
    own, scale = take(clouds, learned.index), learned.similarity.scale
    placement = true_placements(own, extent, learned.similarity, template.sliding[:, 0])
    back = invert(own.camera_T_part[:, 0])
    larger = placement.log_scale.exp()[:, None]
    axis = F.normalize((own.joints.axis @ back[:, :3, :3].mT).mean(0), dim=-1)
    template.axis.copy_(axis)
    pivot = apply(back, own.joints.pivot) * scale[:, None, None] / larger
    template.pivot.copy_(pivot.median(0).values)
    placement = replace(
        placement, shift=_shifts(centre * scale[:, None, None], placement, template)
    )
    template.assign(*_shared_surface(own, learned, placement, count))
    loss = _losses(template, learned.views, placement)
    found = SearchResult(placement=placement, loss=loss, margin=torch.zeros_like(loss))
    return Discovery(template=template, found=found)


def rest_boxes(clouds: FullyLabelled) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B P 3"]]:
    """Extent of each cloud's object at rest, and the middle of each of its parts (`ends`), m.

    From all clouds of the object together, in its frame at rest. A part that none shows is in the
    middle of the object.
    """
    parts = clouds.camera_T_part.shape[1]
    extent = clouds.points.new_zeros(len(clouds.points), 3)
    centre = clouds.points.new_zeros(len(clouds.points), parts, 3)
    for number in clouds.instance.unique():
        rows = clouds.instance == number
        some = take(clouds, rows)
        rest = [
            apply(invert(some.camera_T_part[:, p]), some.points)[some.part == p]
            for p in range(parts)
        ]
        low, high = ends(torch.cat(rest))
        extent[rows] = high - low
        for p, points in enumerate(rest):
            centre[rows, p] = ends(points).mean(0) if len(points) else 0.0
    return extent, centre


def true_placements(
    clouds: FullyLabelled,
    extent: Float[Tensor, "B 3"],
    similarity: Similarity,
    sliding: Float[Tensor, " J"],
) -> Placement:
    """True placements without shifts, in the normalised frame of each cloud.

    Args:
        clouds: Learned ones.
        extent: Of their objects at rest, m; the template's is their geometric mean, normalised.
        similarity: Their normalisation.
        sliding: 1 for a prismatic joint, whose state is a length.
    """
    scale = similarity.scale[:, None]
    pose = clouds.camera_T_part[:, 0]
    size = (extent * scale).log()
    placement = Placement.at(
        pose[:, :3, :3],
        similarity.forward(pose[:, None, :3, 3])[:, 0],
        torch.where(sliding > 0, clouds.joints.state * scale, clouds.joints.state),
    )
    return replace(placement, log_scale=size - size.mean(0))


def _shifts(
    centre: Float[Tensor, "B P 3"], placement: Placement, template: ArticulatedTemplate
) -> Float[Tensor, "B J 3"]:
    """Where sliding parts sit on the body across their axes, against the mean of all objects."""
    larger = placement.log_scale.exp()[:, None]
    shift = centre[:, 1:] - larger * (centre[:, 1:] / larger).mean(0)
    axis = template.directions()
    along = (shift * axis).sum(-1, keepdim=True) * axis
    return (shift - along) * template.sliding


def _shared_surface(
    clouds: FullyLabelled, learned: LearnedClouds, placement: Placement, count: int
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"], Float[Tensor, "M P"]]:
    """Points, normals and part logits of the surface that most clouds share, spread out."""
    points, normals, part = _at_rest(clouds, learned, placement)
    shown: Float[Tensor, "C P"] = F.one_hot(part, clouds.camera_T_part.shape[1]).to(points)
    feature = surface_features(points, normals, shown)
    same = torch.cat([_same(some, feature[::COUNTED]).sum(1) for some in feature.split(16 * CHUNK)])
    good = torch.zeros_like(part, dtype=torch.bool)
    for p in part.unique():
        mine = part == p
        good |= mine & (same >= same[mine].quantile(LEFT_OUT))
    feature, points, normals, shown = feature[good], points[good], normals[good], shown[good]
    index = spread_out(feature, min(count, len(points)))
    share = torch.cat([_same(some, feature) for some in feature[index].split(16 * CHUNK)])
    share = share / share.sum(-1, keepdim=True)
    logit = (share @ shown).clamp_min(LEAST_SHARE).log()
    return share @ points, F.normalize(share @ normals, dim=-1), logit


def _same(feature: Float[Tensor, "C D"], others: Float[Tensor, "O D"]) -> Float[Tensor, "C O"]:
    """How far points have the same surface as others, 1 to 0."""
    return torch.exp(-torch.cdist(feature, others).square() / (2 * SHARED**2))


def _at_rest(
    clouds: FullyLabelled, learned: LearnedClouds, placement: Placement
) -> tuple[Float[Tensor, "C 3"], Float[Tensor, "C 3"], Int[Tensor, " C"]]:
    """Points, normals and parts of the views, all in the template's frame, size and state."""
    views = learned.views
    count = max(LEAST_COUNT, min(views.points.shape[1], ALL_COUNT // len(views.points)))
    seen, normals = views.points[:, :count], views.normals[:, :count]
    part = clouds.part.gather(1, nearest(seen, learned.similarity.forward(clouds.points)))
    rest, facing = torch.zeros_like(seen), torch.zeros_like(normals)
    none = torch.zeros_like(placement.shift[:, :1])
    shift = torch.cat([none, placement.shift], 1)
    for p in range(clouds.camera_T_part.shape[1]):
        turn = clouds.camera_T_part[:, p, :3, :3]
        move = learned.similarity.forward(clouds.camera_T_part[:, p, None, :3, 3])
        own = (part == p)[..., None]
        rest = torch.where(own, (seen - move) @ turn - shift[:, p, None], rest)
        facing = torch.where(own, normals @ turn, facing)
    known = part >= 0
    rest = rest / placement.log_scale.exp()[:, None]
    return rest[known], facing[known], part[known]


def _losses(
    template: ArticulatedTemplate, views: PartialViews, placement: Placement
) -> Float[Tensor, " B"]:
    """How badly the template explains each view at its placement, as hypotheses are ranked."""
    losses, weight = [], backward_weight(template)
    for index in torch.arange(len(views.points)).split(CHUNK):
        placed = template.place(take(placement, index))
        losses.append(view_loss(take(views, index), placed, RANKED, weight))
    return torch.cat(losses)
