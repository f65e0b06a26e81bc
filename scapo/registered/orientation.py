# SPDX-License-Identifier: MIT
"""How an object stands, told by what most objects of the category look like.

The loss against one template prefers wrong turns where objects differ much in their proportions: a
low chest of drawers on its side is more like a high template that stands. What tells them apart is
not one shape but what shapes have in common: surface that faces the camera's side, a part that
reaches out, cameras above. A small network learns that from views whose turn is known: it looks at
the surface in coarse cells of the frame that a hypothesis gives the view, and is taught to prefer
the right one among turns about the frame's axes.
"""

from __future__ import annotations

from functools import cache

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from scapo.first_weights import initialise
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import take
from scapo.registered.views import PartialViews

CELLS, REACH = 8, 0.75
"""Of the frame's cube along either side, and half that side in normalised lengths."""
SIDES = 6  # Directions of a frame's axes, by which surface in a cell is told apart
ENDS = (0.02, 0.98)  # Quantiles of coordinates between which the cube's middle lies
WIDTH = 64  # Of either hidden layer
SHOWN = 160  # Points of a view in a step, drawn anew
WRONG = 11  # Turns of the 23 wrong ones that a step tells the right one from
JITTER = 0.12  # Rad: standard deviation of the turn away from the known one in a step
EPOCHS, BATCH = 12, 32
RATE, WARM, DECAY = 3e-3, 0.3, 0.05
"""Of AdamW at most, the share of the steps after which it is reached, and weight decay."""
DROPPED, SMOOTHED = 0.3, 0.05  # Share of the first layer left out, and label smoothing
CHARGE, MOST = 0.05, 6.0
"""Loss that one nat costs a hypothesis where objects taught, and nats charged for at most."""
VIEWS_CHARGE = 0.025  # Where single views did, as they were placed
CHUNK = 4096  # Frames that are looked at at once


@cache
def quarter_turns() -> Float[Tensor, "24 3 3"]:
    """The rotations that take the axes of a frame to its axes; the first is none at all."""
    turns = torch.from_numpy(Rotation.create_group("O").as_matrix().round()).float()
    none = (turns - torch.eye(3)).abs().sum((-1, -2)) == 0
    return torch.cat([turns[none], turns[~none]])


def surface_in_cells(
    points: Float[Tensor, "B K 3"], normals: Float[Tensor, "B K 3"]
) -> Float[Tensor, "B D"]:
    """Square root of how much surface each cell has that faces either way along each axis.

    Points share in the eight cells around them, and by the squared cosine in three directions.

    Args:
        points: In the frame that is looked at; their box (`ENDS`) is put in the cube's middle.
        normals: Unit.
    """
    count, shown = points.shape[:2]
    ends = points.quantile(torch.tensor(ENDS).to(points), 1)
    place = (points - ends.mean(0)[:, None]) / REACH
    place = ((place + 1) / 2 * (CELLS - 1)).clamp(0, CELLS - 1 - 1e-3)
    cell, beside = place.floor().long(), place.frac()
    facing = torch.cat([normals.clamp_min(0).square(), (-normals).clamp_min(0).square()], -1)
    surface = points.new_zeros(count, CELLS**3, SIDES)
    for corner in torch.cartesian_prod(*[torch.arange(2, device=points.device)] * 3):
        share = torch.where(corner == 1, beside, 1 - beside).prod(-1, keepdim=True)
        x, y, z = (cell + corner).unbind(-1)
        index = ((x * CELLS + y) * CELLS + z)[..., None].expand(-1, -1, SIDES)
        surface.scatter_add_(1, index, share * facing)
    return (surface.flatten(1) * (CELLS**2 / shown)).sqrt()


@cache
def _turned_index() -> Int[Tensor, "24 D"]:
    """Where each entry of `surface_in_cells` is found in that of the frame before its turn."""
    middle = torch.arange(CELLS) - (CELLS - 1) / 2
    cells = torch.cartesian_prod(middle, middle, middle)
    sides = torch.cat([torch.eye(3), -torch.eye(3)])
    rows = []
    for turn in quarter_turns():  # points of the turned frame are points @ turn
        was = (cells @ turn.mT + (CELLS - 1) / 2).round().long()
        cell = (was[:, 0] * CELLS + was[:, 1]) * CELLS + was[:, 2]
        side = ((sides @ turn.mT) @ sides.mT).argmax(-1)
        rows.append((cell[:, None] * SIDES + side).flatten())
    return torch.stack(rows)


class OrientationScorer(nn.Module):
    """Tells how likely a view's frame is the template's, up to a constant of the view."""

    learned: Tensor
    """1 once it was taught; before, it is not asked."""

    price: Tensor
    """Loss that one nat costs a hypothesis."""

    def __init__(self) -> None:
        """Not taught yet."""
        super().__init__()
        self.surface = nn.Linear(CELLS**3 * SIDES, WIDTH)
        self.camera = nn.Linear(3 + 9, WIDTH, bias=False)
        self.hidden = nn.Linear(WIDTH, WIDTH)
        self.last = nn.Linear(WIDTH, 1)
        self.register_buffer("learned", torch.zeros(()))
        self.register_buffer("price", torch.tensor(CHARGE))
        initialise(self, torch.Generator().manual_seed(0))

    def forward(
        self, views: PartialViews, rotation: Float[Tensor, "B F 3 3"]
    ) -> Float[Tensor, "B F"]:
        """A score for each frame.

        Args:
            views: B views.
            rotation: view_R_template of F hypotheses of each.
        """
        scores = []
        size = max(1, CHUNK // rotation.shape[1])
        for index in torch.arange(len(rotation), device=rotation.device).split(size):
            turn, some = rotation[index], take(views, index)
            points = (some.points[:, None] @ turn).flatten(0, 1)
            normals = (some.normals[:, None] @ turn).flatten(0, 1)
            camera = (some.direction()[:, None, None] @ turn)[:, :, 0]
            surface = surface_in_cells(points, normals).unflatten(0, turn.shape[:2])
            scores.append(self._score(surface, camera))
        return torch.cat(scores)

    def _score(
        self,
        surface: Float[Tensor, "B F D"],
        camera: Float[Tensor, "B F 3"],
        kept: Float[Tensor, "B F W"] | None = None,
    ) -> Float[Tensor, "B F"]:
        square = (camera[..., :, None] * camera[..., None, :]).flatten(-2)
        found = self.surface(surface) + self.camera(torch.cat([camera, square], -1))
        found = found.relu() if kept is None else found.relu() * kept
        return self.last(self.hidden(found).relu())[..., 0]

    @torch.no_grad()
    def charge(
        self, views: PartialViews, rotation: Float[Tensor, "B F 3 3"]
    ) -> Float[Tensor, "B F"]:
        """What hypotheses cost for how unlikely they are beside the others of their view."""
        if not bool(self.learned):
            return torch.zeros_like(rotation[..., 0, 0])
        return self.price * (-self(views, rotation).log_softmax(-1)).clamp_max(MOST)

    @torch.enable_grad()
    def learn(
        self,
        views: PartialViews,
        rotation: Float[Tensor, "B 3 3"],
        generator: torch.Generator,
        epochs: int = EPOCHS,
        price: float = CHARGE,
    ) -> OrientationScorer:
        """Learn anew from views whose turns are known; returns itself.

        Args:
            views: B views, on the host.
            rotation: view_R_template of each.
            generator: On the host.
            epochs: Over all of them.
            price: Loss that one nat costs from then on.
        """
        initialise(self, generator)
        count = len(rotation)
        batches = [
            index for _ in range(epochs)
            for index in torch.randperm(count, generator=generator).split(BATCH)
        ]  # fmt: skip
        optimiser = torch.optim.AdamW(self.parameters(), RATE, weight_decay=DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, RATE, total_steps=len(batches), pct_start=WARM
        )
        for index in batches:
            loss = self._loss(take(views, index), rotation[index], generator)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        self.learned.fill_(1.0)
        self.price.fill_(price)
        return self

    def _loss(
        self, views: PartialViews, rotation: Float[Tensor, "B 3 3"], generator: torch.Generator
    ) -> Tensor:
        count, every = len(rotation), views.points.shape[1]
        shown = torch.randperm(every, generator=generator)[:SHOWN]
        turn = rotvec_to_rotmat(JITTER * torch.randn(count, 3, generator=generator))
        frame = rotation @ turn
        surface = surface_in_cells(views.points[:, shown] @ frame, views.normals[:, shown] @ frame)
        wrong = torch.randperm(len(quarter_turns()) - 1, generator=generator)[:WRONG] + 1
        number = F.pad(wrong, (1, 0))  # the right one is the first
        surface = surface[:, _turned_index()[number]]
        camera = (views.direction()[:, None] @ frame)[:, None] @ quarter_turns()[number]
        drawn = torch.rand(*surface.shape[:2], WIDTH, generator=generator)
        kept = (drawn >= DROPPED) / (1 - DROPPED)
        score = self._score(surface, camera[:, :, 0], kept)
        right = torch.zeros(count, dtype=torch.long)
        return F.cross_entropy(score, right, label_smoothing=SMOOTHED)
