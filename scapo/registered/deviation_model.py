# SPDX-License-Identifier: MIT
"""How the axes of a category's hinges deviate, learned from observed rotations of their parts.

A category has one axis for each hinge; the hinges of its objects may lie to either side of it. A
deviation tau (a rotation vector) turns the axis a to exp(tau) a, and the part's motion with it. At
one state r, its rest, it leaves the part where it is; at state s the part is seen rotated, to first
order by (1 - R(a, s - r)) tau, in the part's own frame by

    t = (R(a, -s) - R(a, -r)) tau + noise.

Deviations are one number per object: tau = z load, z ~ N(0, 1), the same z for all hinges. The load
may have to lie in a span: hinges that are parallel stay so where all deviate alike. What single
hinges do beyond that is noise, learned in the part's own frame: of a thin part, a turn about its
length is hardly seen. Load and noise maximise the likelihood of the rotations (a factor analysis);
the deviation of a view is then the mean of z given its rotations.

Vectors of D = 2 J numbers are J rotations one after the other, each along the two directions of
`across_axis`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

FREEDOM = 6.0
"""Of the Student distribution that observations are taken from: some views are placed wrongly."""
HIDDEN = 1e3  # Variance (rad^2) of a rotation that was not seen: it does not count
RIDGE, LEAST_NOISE = 1e-3, 1e-6
"""Added to the load's system, and variance (rad^2) that noise has at least."""
FIRST_NOISE, FIRST_LOAD = 0.004, 0.1
"""Variance (rad^2) and size (rad) that maximisation begins with, usual ones."""
OUTLYING = 0.15
"""Rotation (rad) from which on an observation counts by its direction alone at the beginning."""
STEPS, LAST_STEPS = 15, 50  # Of maximisation for each rest that is tried, and for the best


@dataclass(frozen=True, slots=True, kw_only=True)
class PartRotations:
    """How B views see J parts turned from where the category's axes put them."""

    turn: Float[Tensor, "B J 2"]
    """Rotation vectors (rad) in the part's own frame, along the two directions of `across_axis`;
    what is along the axis belongs to the state."""
    seen: Bool[Tensor, "B J"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviationModel:
    """How the hinges of one category deviate from its axes."""

    rest: Float[Tensor, " J"]
    load: Float[Tensor, " D"]
    noise: Float[Tensor, "D D"]
    """Covariance; zero between hinges."""
    likelihood: float = -torch.inf
    """Mean logarithm over the views it was learned from."""


@torch.no_grad()
def learn_deviations(
    observed: PartRotations,
    state: Float[Tensor, "B J"],
    rests: Float[Tensor, "J R"],
    span: Float[Tensor, "D E"] | None = None,
) -> DeviationModel:
    """The likeliest deviations.

    Args:
        observed: Rotations of B views.
        state: Their states.
        rests: Of each hinge, to choose from.
        span: Columns that the load is made of; None: any load.
    """
    joints = state.shape[1]
    noise = FIRST_NOISE * torch.eye(2 * joints)
    span = torch.eye(2 * joints) if span is None else span
    best = DeviationModel(rest=rests[:, 0], load=noise[0], noise=noise)
    for j in list(range(joints)) * (2 if joints > 1 else 1):
        for place in rests[j]:
            rest = torch.where(torch.arange(joints) == j, place, best.rest)
            load = _first_load(observed, state, rest, span)
            start = DeviationModel(rest=rest, load=load, noise=noise)
            found = _maximise(observed, state, start, span, STEPS)
            best = max(best, found, key=lambda model: model.likelihood)
    return _maximise(observed, state, best, span, LAST_STEPS)


@torch.no_grad()
def expected_deviations(
    model: DeviationModel, observed: PartRotations, state: Float[Tensor, "B J"]
) -> Float[Tensor, "B J 2"]:
    """The mean of each view's deviations given its rotations, along `across_axis`."""
    turn, effect = observed.turn.flatten(1), _response(state, model.rest) @ model.load
    precision = torch.linalg.inv(model.noise + _unseen(observed.seen))
    amount = torch.einsum("bi,bij,bj->b", effect, precision, turn)
    amount = amount / (1 + torch.einsum("bi,bij,bj->b", effect, precision, effect))
    return (amount[:, None] * model.load).unflatten(1, (*state.shape[1:], 2))


def _first_load(
    observed: PartRotations,
    state: Float[Tensor, "B J"],
    rest: Float[Tensor, " J"],
    span: Float[Tensor, "D E"],
) -> Float[Tensor, " D"]:
    """Where the rotations respond most: the likelihood has one peak and its mirror image."""
    turn = (observed.turn * observed.seen[..., None]).flatten(1)
    turn = turn / turn.norm(dim=-1, keepdim=True).clamp_min(OUTLYING)
    back = (turn[:, None] @ _response(state, rest))[:, 0] @ span
    return FIRST_LOAD * span @ torch.linalg.eigh(back.T @ back).eigenvectors[:, -1]


def _maximise(
    observed: PartRotations,
    state: Float[Tensor, "B J"],
    start: DeviationModel,
    span: Float[Tensor, "D E"],
    steps: int,
) -> DeviationModel:
    """Expectation maximisation of load and noise, the rest held, and their likelihood."""
    joints = state.shape[1]
    turn, size = observed.turn.flatten(1), 2 * joints
    seen = observed.seen.to(turn).repeat_interleave(2, 1)
    eye, response, hidden = torch.eye(size), _response(state, start.rest), _unseen(observed.seen)
    alone = torch.block_diag(*[torch.ones(2, 2)] * joints)
    load, noise, likelihood = start.load, start.noise, torch.tensor(0.0)
    for step in range(steps + 1):
        effect = (response @ load[:, None])[..., 0]
        covariance = effect[:, :, None] * effect[:, None] + noise + hidden
        odd = torch.einsum("bi,bij,bj->b", turn, torch.linalg.inv(covariance), turn)
        if step == steps:
            tail = (FREEDOM + size) * torch.log1p(odd / FREEDOM)
            likelihood = -0.5 * (torch.logdet(covariance) + tail).mean()
            break
        weight = (FREEDOM + size) / (FREEDOM + odd)
        precision = torch.linalg.inv(noise + hidden)
        variance = 1 / (1 + torch.einsum("bi,bij,bj->b", effect, precision, effect))
        mean = variance * torch.einsum("bi,bij,bj->b", effect, precision, turn)
        system = torch.einsum(
            "b,bki,bkl,blj->ij", weight * mean**2 + variance, response, precision, response
        )
        right = torch.einsum("b,bki,bkl,bl->i", weight * mean, response, precision, turn)
        inner = span.T @ (system + RIDGE * eye) @ span
        load = span @ torch.linalg.solve(inner, span.T @ right)
        effect = (response @ load[:, None])[..., 0]
        off = (turn - effect * mean[:, None]) * seen * weight[:, None].sqrt()
        left = torch.cat([off, effect * seen * variance[:, None].sqrt()])
        noise = left.T @ left * alone / seen.sum(0).clamp_min(1)[:, None] + LEAST_NOISE * eye
        noise = (noise + noise.T) / 2
    return DeviationModel(rest=start.rest, load=load, noise=noise, likelihood=float(likelihood))


def _response(state: Float[Tensor, "B J"], rest: Float[Tensor, " J"]) -> Float[Tensor, "B D D"]:
    """What a deviation does to the rotations: R(-s) - R(-r) of every hinge, on the diagonal."""
    both = torch.stack([state, rest.expand_as(state)])
    cos, sin = both.cos(), both.sin()
    turn = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)
    blocks = turn[0] - turn[1]
    count, joints = state.shape
    table = blocks.new_zeros(count, joints, 2, joints, 2)
    for j in range(joints):
        table[:, j, :, j] = blocks[:, j]
    return table.flatten(3, 4).flatten(1, 2)


def _unseen(seen: Bool[Tensor, "B J"]) -> Float[Tensor, "B D D"]:
    """Variance of the rotations that were not seen."""
    return torch.diag_embed(HIDDEN * (~seen).float().repeat_interleave(2, 1))
