# SPDX-License-Identifier: MIT
"""How a template lies in whole surfaces, where it was learned from single views.

A whole surface is looked at from many sides, as far away as the views' cameras were: of its points
those stay that a camera there would see (hidden point removal by a convex hull, Katz, Tal and Basri
2007). The network says of each side how the template lies; sides that no camera ever saw are
told wrongly, each in its own way, the others agree, so the rotation that most of them say is
taken. Of the sides that say so the one counts whose placement fits the whole surface best, and is
fitted to it. Distances of the template's points count as they are, those of the surface's at most
`FAR`: what no view showed the template does not have.

Lengths are in normalised units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from scapo.geometry.points import Similarity, fibonacci_sphere, squared_distances
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import cat, map_tensors, take
from scapo.registered.pairwise import within
from scapo.registered.synchronisation import densest
from scapo.registered.template import ArticulatedTemplate, Placement, across_axis
from scapo.types import Observation

SIDES = 24
REACH = 10.0**1.5
"""Radius of the sphere at which points are flipped for hidden point removal, over the farthest
point's distance: with more, points are seen through gaps of a thousand points."""
SHOWN = 384  # Points of a side that are looked at; where fewer are seen they are repeated
AGREES = 25.0  # Degrees from the rotation that most sides say
MISFIT = 20.0  # What a side's word counts: how sure it is, times exp(-MISFIT x misfit)
FITTED = (256, 512)  # Points of the template and of a surface that are compared
STEPS, RATE = 80, 0.02  # Of Adam; the rate falls to a tenth
FAR = 0.08
SIZE, ASIDE = 0.05, 0.4  # Weights of squared log scales from the start's, and of squared shifts
FREE = ("translation", "log_scale", "state", "shift")


Ask = Callable[[Observation], tuple[Placement, Float[Tensor, " B"], Similarity]]
"""A network's word of views: placements in normalised clouds, how sure it is, that normalisation"""


@torch.no_grad()
def lying(
    template: ArticulatedTemplate, ask: Ask, away: float, surfaces: Float[Tensor, "B N 3"]
) -> tuple[Placement, Float[Tensor, " B"]]:
    """Where the template lies, and which share of the sides' word says so.

    Args:
        template: That the network knows.
        ask: The network.
        away: Distance of the cameras from the middle of a surface.
        surfaces: Normalised, in any pose.
    """
    every = [_said(template, ask, surfaces, camera) for camera in away * fibonacci_sphere(SIDES)]
    rotation = torch.stack([said.rotation for said, _ in every], 1)  # (B, S, 3, 3)
    shapes = [template.with_points(FITTED[0]).place(said)[0] for said, _ in every]
    some = surfaces[:, :: max(1, surfaces.shape[1] // FITTED[1])]
    off = torch.stack([misfit(some, shape) for shape in shapes], 1)
    vote = torch.stack([sure for _, sure in every], 1) * torch.exp(-MISFIT * off)
    pairs = zip(rotation, vote, strict=True)
    common, share = zip(*(densest(turns, votes) for turns, votes in pairs), strict=True)
    agree = within((rotation * torch.stack(common)[:, None]).sum((-1, -2)), AGREES)
    best = torch.where(agree, off, off + 1).argmin(1)
    row = torch.arange(len(best), device=best.device)
    begun = take(cat([said for said, _ in every]), best * len(best) + row)
    return _fitted(template, some, begun), torch.stack(share)


def _said(
    template: ArticulatedTemplate,
    ask: Ask,
    surfaces: Float[Tensor, "B N 3"],
    camera: Float[Tensor, " 3"],
) -> tuple[Placement, Float[Tensor, " B"]]:
    """What the network says of the side that a camera sees, and how sure it is."""
    camera = camera.to(surfaces)
    side = torch.stack([_shown(points[seen(points, camera)]) for points in surfaces])
    where = camera.expand(len(surfaces), 3)
    said, sure, similarity = ask(Observation(points=side, sensor=where))
    size = 1 / similarity.scale[:, None]
    placement = replace(
        said,
        translation=said.translation * size + similarity.centre,
        log_scale=said.log_scale + size.log(),
        state=torch.where(template.sliding[:, 0] > 0, said.state * size, said.state),
        shift=said.shift * size[..., None],
        pivot=None if said.pivot is None else said.pivot * size[..., None],
    )
    return placement, sure


def seen(points: Float[Tensor, "N 3"], camera: Float[Tensor, " 3"]) -> Bool[Tensor, " N"]:
    """Which points a camera sees (hidden point removal); all that lie in one plane with it."""
    from scipy.spatial import ConvexHull, QhullError

    away = (points - camera).double().cpu().numpy()
    far = np.linalg.norm(away, axis=1, keepdims=True)
    flipped = away * (2 * REACH * far.max() / far - 1)
    try:
        corner = ConvexHull(np.vstack([flipped, np.zeros((1, 3))])).vertices
    except QhullError:
        return torch.ones(len(points), dtype=torch.bool, device=points.device)
    mask = torch.zeros(len(points) + 1, dtype=torch.bool)
    mask[torch.as_tensor(corner.astype(np.int64))] = True
    return mask[:-1].to(points.device)


def _shown(points: Float[Tensor, "N 3"]) -> Float[Tensor, "K 3"]:
    """As many points of any number of them, spread over their order."""
    return points[torch.arange(SHOWN) * max(len(points), SHOWN) // SHOWN % len(points)]


def misfit(surfaces: Float[Tensor, "B N 3"], shapes: Float[Tensor, "B M 3"]) -> Float[Tensor, " B"]:
    """Mean distance of the shapes' points to the nearest of the surfaces, and back up to `FAR`."""
    there, back = squared_distances(shapes, surfaces), squared_distances(surfaces, shapes)
    far = FAR * torch.tanh((back + 1e-6).sqrt() / FAR)
    return (there + 1e-6).sqrt().mean(1) + far.mean(1)


@torch.enable_grad()
def _fitted(
    template: ArticulatedTemplate, surfaces: Float[Tensor, "B N 3"], begun: Placement
) -> Placement:
    """Adam on the misfit."""
    template = template.with_points(FITTED[0]).requires_grad_(False)
    free = [torch.zeros_like(begun.translation), *(getattr(begun, name).clone() for name in FREE)]
    free = [value.requires_grad_() for value in free]
    across = torch.stack([across_axis(axis) for axis in template.directions()])  # (J, 2, 3)

    def placed() -> Placement:
        values = dict(zip(FREE, free[1:], strict=True))
        values["shift"] = (across.mT @ across @ values["shift"][..., None])[..., 0]
        return replace(begun, rotation=begun.rotation @ rotvec_to_rotmat(free[0]), **values)

    def cost(at: Placement) -> Tensor:
        sizes = (at.log_scale - begun.log_scale).square().mean(1)
        price = SIZE * sizes + ASIDE * at.shift.square().sum((1, 2))
        return misfit(surfaces, template.place(at)[0]) + price

    optimizer = torch.optim.Adam(free, lr=RATE, betas=(0.9, 0.99))
    for k in range(STEPS):
        optimizer.param_groups[0]["lr"] = RATE * 0.1 ** (k / STEPS)
        optimizer.zero_grad()
        cost(placed()).sum().backward()
        optimizer.step()
    end = placed()
    if begun.pivot is not None:  # hinges sit on the base, whose sizes were fitted
        grown = (end.log_scale - begun.log_scale).exp()
        end = replace(end, pivot=begun.pivot * grown[:, None])
    return map_tensors(end, Tensor.detach)
