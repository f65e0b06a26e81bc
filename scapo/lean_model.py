# SPDX-License-Identifier: MIT
"""How the hinges of a category lean, learned from the tilts of many views.

A category has one axis for each hinge; the hinges of its objects may lean to either side of it. A
lean tau (a rotation vector) turns the axis a to exp(tau) a, and the part's motion with it. At one
state r, its rest, it leaves the part where it is; at state s the part is seen tilted, to first
order by (1 - R(a, s - r)) tau, in the part's own frame by

    t = (R(a, -s) - R(a, -r)) tau + noise.

Leans are one number per object: tau = z load, z ~ N(0, 1), the same z for all hinges. What single
hinges do beyond that is noise, learned in the part's own frame: of a thin part, a turn about its
length is hardly seen. Load and noise maximise the likelihood of the tilts (a factor analysis); the
lean of a view is then the mean of z given its tilts.

Vectors of D = 2 J numbers are J tilts one after the other, each along the two directions of
`joint_fit.across_axis`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from scapo.tilts import Tilts

FREEDOM = 6.0
"""Of the Student distribution that tilts are taken from: some views are placed wrongly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LeanModel:
    """Of one category."""

    rest: Float[Tensor, " J"]
    load: Float[Tensor, " D"]
    noise: Float[Tensor, "D D"]
    """Covariance; zero between hinges."""
    likelihood: float = -torch.inf
    """Mean logarithm over the views it was learned from."""


def _response(state: Float[Tensor, "B J"], rest: Float[Tensor, " J"]) -> Float[Tensor, "B D D"]:
    """What a lean does to the tilts: R(-s) - R(-r) of every hinge, on the diagonal."""
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
    """Variance so large that a tilt which was not seen does not count."""
    return torch.diag_embed(1e3 * (~seen).float().repeat_interleave(2, 1))


def _climb(tilts: Tilts, state: Float[Tensor, "B J"], start: LeanModel, steps: int) -> LeanModel:
    """Expectation maximisation of load and noise, the rest held, and their likelihood."""
    joints = state.shape[1]
    turn, size = tilts.turn.flatten(1), 2 * joints
    seen = tilts.seen.to(turn).repeat_interleave(2, 1)
    eye, response, hidden = torch.eye(size), _response(state, start.rest), _unseen(tilts.seen)
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
        trust = (FREEDOM + size) / (FREEDOM + odd)
        precision = torch.linalg.inv(noise + hidden)
        variance = 1 / (1 + torch.einsum("bi,bij,bj->b", effect, precision, effect))
        mean = variance * torch.einsum("bi,bij,bj->b", effect, precision, turn)
        system = torch.einsum(
            "b,bki,bkl,blj->ij", trust * mean**2 + variance, response, precision, response
        )
        right = torch.einsum("b,bki,bkl,bl->i", trust * mean, response, precision, turn)
        load = torch.linalg.solve(system + 1e-3 * eye, right)
        effect = (response @ load[:, None])[..., 0]
        left = torch.cat(
            [
                (turn - effect * mean[:, None]) * seen * trust[:, None].sqrt(),
                effect * seen * variance[:, None].sqrt(),
            ]
        )
        noise = left.T @ left * alone / seen.sum(0).clamp_min(1)[:, None] + 1e-6 * eye
        noise = (noise + noise.T) / 2
    return LeanModel(rest=start.rest, load=load, noise=noise, likelihood=float(likelihood))


@torch.no_grad()
def learn(tilts: Tilts, state: Float[Tensor, "B J"], rests: Float[Tensor, "J R"]) -> LeanModel:
    """The likeliest leans.

    Args:
        tilts: Of B views.
        state: Their states.
        rests: Of each hinge, to choose from.
    """
    joints = state.shape[1]
    noise = 0.004 * torch.eye(2 * joints)
    best = LeanModel(rest=rests[:, 0], load=noise[0], noise=noise)
    for j in list(range(joints)) * (2 if joints > 1 else 1):
        for place in rests[j]:
            rest = torch.where(torch.arange(joints) == j, place, best.rest)
            start = LeanModel(rest=rest, load=_first_load(tilts, state, rest), noise=noise)
            best = max(best, _climb(tilts, state, start, 15), key=lambda model: model.likelihood)
    return _climb(tilts, state, best, 50)


def _first_load(
    tilts: Tilts, state: Float[Tensor, "B J"], rest: Float[Tensor, " J"]
) -> Float[Tensor, " D"]:
    """Where the tilts respond most, of a usual size: the likelihood has one peak and its mirror."""
    turn = (tilts.turn * tilts.seen[..., None]).flatten(1)
    turn = turn / turn.norm(dim=-1, keepdim=True).clamp_min(0.15)
    back = (turn[:, None] @ _response(state, rest))[:, 0]
    return 0.1 * torch.linalg.eigh(back.T @ back).eigenvectors[:, -1]


@torch.no_grad()
def expected(model: LeanModel, tilts: Tilts, state: Float[Tensor, "B J"]) -> Float[Tensor, "B J 2"]:
    """The mean of each view's leans given its tilts, along `across_axis`."""
    turn, effect = tilts.turn.flatten(1), _response(state, model.rest) @ model.load
    precision = torch.linalg.inv(model.noise + _unseen(tilts.seen))
    amount = torch.einsum("bi,bij,bj->b", effect, precision, turn)
    amount = amount / (1 + torch.einsum("bi,bij,bj->b", effect, precision, effect))
    return (amount[:, None] * model.load).unflatten(1, (*state.shape[1:], 2))
