# SPDX-License-Identifier: MIT
"""How well a placed template explains a view: the loss that search and fit minimise.

Every observed point must lie on the placed template with the same normal (robust, so that details
missing from the template cost a bounded amount), and every template point that this camera would
have seen must have been seen. Template points that something hides or that face away cost nothing.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.geometry.points import gather, nearest
from scapo.registered.template import oriented
from scapo.registered.views import PartialViews

NORMAL_WEIGHT = 1.5  # Of 1 - cosine of the normals beside sharpness times squared distance
GRAZING = 0.1  # Cosine of a surface's normal and the ray above which a camera sees it
SEEN_WITHIN = 0.03
"""Normalised length along the ray within which a point counts as what the camera saw there."""


def match_weight(
    squared_distance: Float[Tensor, "*B"],
    sharpness: float,
    cosine: Float[Tensor, "*B"] | None = None,
) -> Float[Tensor, "*B"]:
    """exp(-k d^2 - w (1 - cos)): 1 for points that match in place and normal, towards 0 if not.

    Args:
        squared_distance: d^2 of the points, normalised.
        sharpness: k, per squared normalised length.
        cosine: Of their normals; None where they do not count.
    """
    exponent = -sharpness * squared_distance
    if cosine is not None:
        exponent = exponent - NORMAL_WEIGHT * (1 - cosine)
    return exponent.exp()


def normal_weight(cosine: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    """exp(-w (1 - cos)), the part of `match_weight` that the normals have."""
    return torch.exp(-NORMAL_WEIGHT * (1 - cosine))


def sharpened(ends: tuple[float, float], steps: int) -> list[float]:
    """Sharpness (k of `match_weight`) of every step: a geometric row from the first to the last."""
    low, high = ends
    return [low * (high / low) ** (step / max(steps - 1, 1)) for step in range(steps)]


@torch.no_grad()
def oriented_nearest(
    points: Float[Tensor, "B K 3"],
    normals: Float[Tensor, "B K 3"],
    target: Float[Tensor, "B M 3"],
    target_normals: Float[Tensor, "B M 3"],
) -> Int[Tensor, "B K"]:
    """Nearest target in position and normal: the two faces of a thin plate are told apart."""
    return nearest(oriented(points, normals), oriented(target, target_normals))


@torch.no_grad()
def should_be_seen(
    views: PartialViews, points: Float[Tensor, "B M 3"], normals: Float[Tensor, "B M 3"]
) -> Bool[Tensor, "B M"]:
    """Whether the camera would have seen each placed template point."""
    free, hidden = views.free_and_hidden(points, SEEN_WITHIN)
    ray = F.normalize(views.camera[:, None] - points, dim=-1)
    return free | (((normals * ray).sum(-1) > GRAZING) & ~hidden)


def view_loss(
    views: PartialViews,
    placed: tuple[Float[Tensor, "B M 3"], Float[Tensor, "B M 3"]],
    sharpness: float,
    backward: float | Float[Tensor, " M"] = 1.0,
) -> Float[Tensor, " B"]:
    """Robust distance of each view to a placed template, both ways, self-occlusion respected.

    Args:
        views: B views.
        placed: Points and normals of the template in each view.
        sharpness: k of `match_weight`.
        backward: Weight of the template's visible points, or of each.
    """
    points, normals = placed
    index = oriented_nearest(views.points, views.normals, points, normals)
    off = (views.points - gather(points, index)).square().sum(-1)
    cosine = (views.normals * gather(normals, index)).sum(-1)
    there = 1 - match_weight(off, sharpness, cosine)
    with torch.no_grad():
        counts = should_be_seen(views, points, normals).to(points.dtype)
        back = oriented_nearest(points, normals, views.points, views.normals)
    off = (points - gather(views.points, back)).square().sum(-1)
    missed = backward * (1 - match_weight(off, sharpness)) * counts
    return there.mean(-1) + missed.mean(-1)
