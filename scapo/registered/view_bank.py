# SPDX-License-Identifier: MIT
"""Template matching: a view beside small images of the template, and of views that are placed.

A bank holds what cameras about the template's frame see, as small orthographic images about the
centroid of what is seen, in units of its mean radius: how much surface each cell shows, its depth
and its normal. Images are of the template itself in some states, places and sizes (`rendered`), or
of views whose placements are known (`placed`), which show handles, feet and proportions that one
template lacks. A view at some rolls about its ray is compared with all of them by one matrix
product. That proposes placements (`propose`), and tells those after which a view looks like others
that were placed (`unlikeness`), without any label.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.geometry.points import MEAN_RADIUS
from scapo.geometry.rigid import rotation_between
from scapo.records import cat, take
from scapo.registered.pairwise import distinct, within
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.view_loss import GRAZING
from scapo.registered.views import FAR, TINY, PartialViews

DIRECTIONS = 200  # On the sphere: 14 degrees from one to the next
ROLLS = 24  # Of a view about its ray: every 15 degrees
CELLS, EXTENT = 12, 0.6
"""Of an image along either side, and half that side in normalised lengths."""
FILLED = 0.3  # Points in a cell, of `SPLATTED`, at which it counts as half filled
SPLATTED = 64.0  # What the points of an image weigh together
DEPTH_WEIGHT, NORMAL_WEIGHT = 2.0, 0.7  # Of depths (per normalised length) and normals
POINTS = 128  # Of a view, and about as many of a template's that a camera sees
NEAR = 0.3  # Cosine of directions above which a camera is near one that inliers used
BUFFER, BEHIND = 16, 0.1
"""Cells of the depth buffer along either side, and how far (normalised length) behind the first
surface in a cell a point is hidden."""
DISTANCE = 2.0  # Normalised length from the template's middle to its cameras
SHORTLIST = 4  # Rotations that are told apart for each hypothesis that is kept
SPACED = 22.0  # Degrees between hypotheses that are kept
WANTED = 15.0  # Degrees from a rotation that is asked for
CHUNK = 8  # Views that are compared at once
ALIKE, SAME_SIDE = 4, 0.9
"""Placed views that a view is compared with, those most like it, and the cosine of directions
within which their cameras are."""
UNLIKE, UNLIKE_WEIGHT = 10.0, 1 / 60
"""Squared distance from which on images have nothing in common, and the loss that counts as one.
Where no view is placed counts the same, so more would keep a side empty that happens to be so."""
TOLD_BY, SAME = 3, 1e-4
"""Points by whose distances from the middle a view is known again, and normalised length up to
which these are the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewBank:
    """What cameras in V directions see, M images of each."""

    look: Float[Tensor, "V 3 3"]
    """camera_R_template, rows as `PartialViews.look`."""
    image: Float[Tensor, "V M D"]
    centre: Float[Tensor, "V M 3"]
    """Centroid of the points seen, template frame."""
    radius: Float[Tensor, "V M"]
    """Mean distance of those from it."""
    mode: Int[Tensor, "V M"]
    """Which of `modes` each shows."""
    modes: Placement
    """Their states, shifts and scales count."""
    slides: Float[Tensor, "J 1"]
    """1 for each prismatic joint, 0 for the others."""
    front: Float[Tensor, "3 3"]
    """Turns the mean direction to the cameras to -z, far from where `look` has no roll."""
    key: Float[Tensor, "V K"] | None = None
    """`_key` of each placed view, so that none is compared with itself."""

    @staticmethod
    @torch.no_grad()
    def rendered(
        template: ArticulatedTemplate,
        modes: Placement,
        cameras: Float[Tensor, "N 3"] | None,
        count: int = DIRECTIONS,
    ) -> ViewBank:
        """Views of the template.

        Args:
            template: Of any number of points; 400 are enough.
            modes: States, shifts and scales, M rows; about the template's own frame.
            cameras: Directions near which cameras stand, None for anywhere.
            count: Directions on the whole sphere.
        """
        direction = sphere(count).to(template.points)
        if cameras is not None:
            if template.mirrored:
                cameras = torch.cat([cameras, cameras @ template.mirror().flip])
            near = (direction @ cameras.mT).amax(-1) > NEAR
            direction = direction[near] if bool(near.any()) else direction
        front = _front(direction)
        look = looks(direction, front)
        points, normals = template.place(modes)
        rows = [_seen(points, normals, one) for one in look]
        image, centre, radius = (torch.stack(column) for column in zip(*rows, strict=True))
        mode = torch.arange(len(points), device=look.device).expand(len(look), -1)
        return ViewBank(
            look=look,
            image=image,
            centre=centre,
            radius=radius,
            mode=mode,
            modes=modes,
            slides=template.sliding,
            front=front,
        )

    @staticmethod
    @torch.no_grad()
    def placed(
        template: ArticulatedTemplate,
        shown: ShownPoints,
        placement: Placement,
        camera: Float[Tensor, "V 3"],
    ) -> ViewBank:
        """Views whose placements are known, as seen from the other side too where that is known.

        Where no view is placed on one side, a view from there looks like none: it is read another
        way, if there is one, and so that side stays empty.

        Args:
            template: For its joints, and what is left and right.
            shown: The views' points, their own frames.
            placement: Of the views.
            camera: Directions to their cameras, template frame.
        """
        if template.mirrored:
            mirror = template.mirror()
            shown = cat([shown, shown.turned(mirror.flip)])
            placement = cat([placement, mirror.placement(placement)])
            camera = torch.cat([camera, camera @ mirror.flip])
        front = _front(camera)
        look = looks(camera, front)
        middle, seen, radius = shown.about_centroid()
        turn = look @ placement.rotation.mT
        image = draw(seen @ turn.mT, shown.normals @ turn.mT, torch.ones_like(seen[..., 0]))
        centre = (placement.rotation.mT @ (middle - placement.translation)[..., None])[..., 0]
        return ViewBank(
            look=look,
            image=image[:, None],
            centre=centre[:, None],
            radius=radius[:, None],
            mode=torch.arange(len(look), device=look.device)[:, None],
            modes=placement,
            slides=template.sliding,
            front=front,
            key=_key(shown.points),
        )

    @torch.no_grad()
    def propose(self, views: PartialViews, keep: int) -> Placement:
        """The `keep` best distinct placements of each view, those of a view in a row."""
        parts = torch.arange(len(views.points), device=views.points.device).split(CHUNK)
        return cat([self._propose(take(views, index), keep) for index in parts])

    def _propose(self, views: PartialViews, keep: int) -> Placement:
        middle, seen, radius = ShownPoints.of(views).about_centroid()
        turn = rolls().to(seen)
        about = turn @ views.look[:, None]  # (B, R, 3, 3), rolled camera frames
        image = _drawn(seen, views.normals[:, :POINTS], about)
        cost, mode = self.distances(image).min(-1)  # (B, R, V)
        short = cost.flatten(1).topk(min(SHORTLIST * keep, cost[0].numel()), largest=False)
        roll, direction = short.indices // len(self.look), short.indices % len(self.look)
        rows = torch.arange(len(seen), device=roll.device)[:, None]
        rotation = about[rows, roll].mT @ self.look[direction]
        best = distinct(rotation, short.values, keep, SPACED)
        mode = mode.flatten(1).gather(1, short.indices.gather(1, best))
        return self._placement(
            rotation[rows, best], (direction.gather(1, best), mode), middle, radius
        )

    @torch.no_grad()
    def turned(self, views: PartialViews, wanted: Float[Tensor, "B 3 3"], keep: int) -> Placement:
        """What looks most like each view of what is turned as wanted, those of a view in a row.

        Args:
            views: B views.
            wanted: view_R_template.
            keep: Placements of each view.
        """
        parts = torch.arange(len(views.points), device=views.points.device).split(CHUNK)
        return cat([self._turned(take(views, index), wanted[index], keep) for index in parts])

    def _turned(self, views: PartialViews, wanted: Float[Tensor, "B 3 3"], keep: int) -> Placement:
        middle, seen, radius = ShownPoints.of(views).about_centroid()
        about = rolls().to(seen) @ views.look[:, None]  # (B, R, 3, 3)
        cost = self.distances(_drawn(seen, views.normals[:, :POINTS], about))  # (B, R, V, M)
        rotation = about[:, :, None].mT @ self.look  # (B, R, V, 3, 3)
        trace = (rotation * wanted[:, None, None]).sum((-1, -2))
        near = within(trace, WANTED) | (trace == trace.amax((1, 2), keepdim=True))
        cost = cost.masked_fill(~near[..., None], torch.inf)
        best = cost.flatten(1).topk(keep, largest=False).indices
        mode = best % cost.shape[3]
        direction = best // cost.shape[3] % cost.shape[2]
        roll = best // (cost.shape[3] * cost.shape[2])
        rows = torch.arange(len(seen), device=best.device)[:, None]
        return self._placement(rotation[rows, roll, direction], (direction, mode), middle, radius)

    def _placement(
        self,
        rotation: Float[Tensor, "B K 3 3"],
        entry: tuple[Int[Tensor, "B K"], Int[Tensor, "B K"]],
        middle: Float[Tensor, "B 3"],
        radius: Float[Tensor, " B"],
    ) -> Placement:
        """What those entries of the bank showed, brought to the size of the views."""
        grown = radius[:, None] / self.radius[entry]
        centre = self.centre[entry] * grown[..., None]
        modes = take(self.modes, self.mode[entry].flatten())
        grown = grown.flatten()
        return Placement(
            rotation=rotation.flatten(0, 1),
            translation=(middle[:, None] - (rotation @ centre[..., None])[..., 0]).flatten(0, 1),
            log_scale=modes.log_scale + grown.log()[:, None],
            state=modes.state * torch.where(self.slides[:, 0] > 0, grown[:, None], 1.0),
            shift=modes.shift * grown[:, None, None],
            deviation=torch.zeros_like(modes.shift),
        )

    def distances(self, image: Float[Tensor, "B R D"]) -> Float[Tensor, "B R V M"]:
        """Squared distances of images to those of the bank."""
        ours = self.image.flatten(0, 1)
        cost = ours.square().sum(-1) - 2 * image.flatten(0, 1) @ ours.mT
        cost = cost.view(*image.shape[:2], *self.image.shape[:2])
        return cost + image.square().sum(-1)[..., None, None]

    @torch.no_grad()
    def unlikeness(
        self, views: PartialViews, rotation: Float[Tensor, "B F 3 3"]
    ) -> Float[Tensor, "B F"]:
        """How far views that stand so look from the bank's views from about the same direction.

        The mean over the `ALIKE` nearest images, in [0, `UNLIKE`] times `UNLIKE_WEIGHT`. Where few
        cameras stood, nothing is like it.

        Args:
            views: B views.
            rotation: view_R_template, F hypotheses of each view.
        """
        _, seen, _ = ShownPoints.of(views).about_centroid()
        direction = (rotation.mT @ views.direction()[:, None, :, None])[..., 0]
        turn = looks(direction.flatten(0, 1), self.front).unflatten(0, direction.shape[:2])
        image = _drawn(seen, views.normals[:, :POINTS], turn @ rotation.mT)
        apart = self.distances(image).amin(-1).clamp_max(UNLIKE)
        away = (direction @ -self.look[:, 2].mT) < SAME_SIDE
        if self.key is not None:
            gap = (_key(views.points)[:, None] - self.key).abs().amax(-1)  # (B, V)
            away = away | (gap < SAME)[:, None]
        apart = torch.where(away, UNLIKE, apart)
        count = min(ALIKE, apart.shape[-1])
        return UNLIKE_WEIGHT * apart.topk(count, largest=False).values.mean(-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ShownPoints:
    """As many points of views as images are drawn of."""

    points: Float[Tensor, "V K 3"]
    normals: Float[Tensor, "V K 3"]

    @staticmethod
    def of(views: PartialViews) -> ShownPoints:
        """The first `POINTS`, which are spread out."""
        return ShownPoints(points=views.points[:, :POINTS], normals=views.normals[:, :POINTS])

    def turned(self, turn: Float[Tensor, "3 3"]) -> ShownPoints:
        """The same after a rotation or a reflection of the views' frames."""
        return ShownPoints(points=self.points @ turn.mT, normals=self.normals @ turn.mT)

    def about_centroid(
        self,
    ) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V K 3"], Float[Tensor, " V"]]:
        """Centroids, points about those at mean radius 0.25, and the mean radii they had."""
        middle = self.points.mean(1)
        seen = self.points - middle[:, None]
        radius = seen.norm(dim=-1).mean(-1).clamp_min(TINY)
        return middle, seen * (MEAN_RADIUS / radius)[:, None, None], radius


def _key(points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B K"]:
    """Tells views apart however they are turned: frames of clouds turn with what is looked at."""
    return points[:, :TOLD_BY].norm(dim=-1)


def _drawn(
    seen: Float[Tensor, "B K 3"],
    normals: Float[Tensor, "B K 3"],
    turn: Float[Tensor, "B F 3 3"],
) -> Float[Tensor, "B F D"]:
    """Images of each view after each of its turns."""
    weight = torch.ones_like(seen[..., 0])[:, None].expand(-1, turn.shape[1], -1)
    return draw(seen[:, None] @ turn.mT, normals[:, None] @ turn.mT, weight)


def sphere(count: int) -> Float[Tensor, "{count} 3"]:
    """Evenly spread directions, the Fibonacci spiral."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z, turn = 1 - 2 * i / count, math.pi * (1 + 5**0.5) * i
    ring = (1 - z.square()).sqrt()
    return torch.stack([ring * turn.cos(), ring * turn.sin(), z], -1).float()


def rolls(count: int = ROLLS) -> Float[Tensor, "{count} 3 3"]:
    """Turns about the ray, evenly spread."""
    angle = 2 * math.pi * torch.arange(count) / count
    cos, sin, none = angle.cos(), angle.sin(), torch.zeros(count)
    rows = [cos, -sin, none, sin, cos, none, none, none, none + 1]
    return torch.stack(rows, -1).view(count, 3, 3)


def draw(
    points: Float[Tensor, "*B K 3"], normals: Float[Tensor, "*B K 3"], weight: Float[Tensor, "*B K"]
) -> Float[Tensor, "*B D"]:
    """Images of oriented points, axes x, y and forward: filling, depth and normal of each cell.

    Points are spread over the cells around them linearly (their middles are `2 EXTENT / CELLS`
    apart), and a cell says how much it holds of what it would hold if more came: neither the
    number of points nor their density enters.
    """
    middle = ((torch.arange(CELLS) + 0.5) / CELLS * 2 - 1) * EXTENT
    width = 2 * EXTENT / CELLS
    share = (1 - (points[..., :2, None] - middle.to(points)).abs() / width).clamp_min(0)
    total = weight.sum(-1, keepdim=True).clamp_min(TINY)
    across = share[..., 0, :] * (SPLATTED * weight / total)[..., None]  # (*B, K, G)
    values = torch.cat(
        [
            torch.ones_like(weight)[..., None],
            DEPTH_WEIGHT * points[..., 2:],
            NORMAL_WEIGHT * normals,
        ],
        -1,
    )
    spread = (across[..., None] * values[..., None, :]).flatten(-2)  # (*B, K, G 5)
    cells = (share[..., 1, :].mT @ spread).unflatten(-1, (CELLS, -1))  # (*B, G, G, 5)
    return (cells / (cells[..., :1] + FILLED)).flatten(-3)


def looks(direction: Float[Tensor, "V 3"], front: Float[Tensor, "3 3"]) -> Float[Tensor, "V 3 3"]:
    """camera_R_template of cameras in those directions; neighbours have nearly the same roll."""
    forward = -direction @ front.mT
    return rotation_between(forward, torch.eye(3).to(forward)[2].expand_as(forward)) @ front


def _front(direction: Float[Tensor, "V 3"]) -> Float[Tensor, "3 3"]:
    """The rotation that takes the mean direction to -z, from where cameras look along z."""
    mean = F.normalize(direction.mean(0, keepdim=True), dim=-1)
    return rotation_between(mean, -torch.eye(3).to(mean)[2:])[0]


def _seen(
    points: Float[Tensor, "M T 3"], normals: Float[Tensor, "M T 3"], look: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "M D"], Float[Tensor, "M 3"], Float[Tensor, " M"]]:
    """Images of the template in all modes from one direction, centroids and mean radii."""
    box = (points.amin(1) + points.amax(1)) / 2
    eye = box - DISTANCE * look[2]
    ray = F.normalize(eye[:, None] - points, dim=-1)
    seen = (points - box[:, None]) @ look.mT
    visible = ((normals * ray).sum(-1) > GRAZING) & ~_hidden(seen)
    weight = visible.float() + TINY
    share = (weight / weight.sum(-1, keepdim=True))[..., None]
    middle = (share * seen).sum(1)
    seen = seen - middle[:, None]
    radius = (share[..., 0] * seen.norm(dim=-1)).sum(-1).clamp_min(TINY)
    scaled = seen * (MEAN_RADIUS / radius)[:, None, None]
    return draw(scaled, normals @ look.mT, weight), box + middle @ look, radius


def _hidden(seen: Float[Tensor, "M T 3"]) -> Bool[Tensor, "M T"]:
    """Whether another point lies before each, in an orthographic depth buffer."""
    low, high = seen[..., :2].amin(1, keepdim=True), seen[..., :2].amax(1, keepdim=True)
    side = (high - low).amax(-1, keepdim=True).clamp_min(TINY)
    cell = ((seen[..., :2] - low) / side * BUFFER).long().clamp(0, BUFFER - 1)
    cell = cell[..., 0] * BUFFER + cell[..., 1]
    depth = seen.new_full((len(seen), BUFFER * BUFFER), FAR)
    depth = depth.scatter_reduce(1, cell, seen[..., 2], "amin")
    return seen[..., 2] > depth.gather(1, cell) + BEHIND
