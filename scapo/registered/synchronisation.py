# SPDX-License-Identifier: MIT
"""Pose synchronisation: one frame for many views from their pairwise registrations, by voting.

A pairwise registration is often wrong, and it may align the moving part instead of the base. But
the right poses of a view, reached through many others, agree, and the wrong ones scatter: aligned
moving parts disagree because states differ. So every view takes the densest of the poses that its
partners propose, each weighted by its squared margin, until nothing changes. The share of the
votes behind the winner is a confidence that needs no label.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from scapo.geometry.rigid import project_rotation
from scapo.registered.pairwise import DISTINCT, Modes, within

TINY = 1e-9  # Least divisor, of sums of votes: squared margins are small numbers
ROOTS = 6  # Starts that are tried: the views with the largest margins
BETA = 30.0  # How sharply the scores of one pair's modes share its vote
SPREAD = 8.0
"""Of exp(-SPREAD angle^2) by which proposals support each other: half of it at 17 degrees."""
PROPOSALS = 160  # Of a view, those with most votes, of which the densest is taken
SWEEPS, STILL = 8, 5.0
"""Over all views at most; they end when every rotation changes by fewer degrees than this."""
AVERAGED = 30  # Sweeps of averaging the translations


@dataclass(frozen=True, slots=True, kw_only=True)
class Synchronised:
    """Poses of N views in one frame."""

    rotation: Float[Tensor, "N 3 3"]
    """world_R_view."""
    translation: Float[Tensor, "N 3"]
    confidence: Float[Tensor, " N"]
    """Share of the votes within about 20 degrees of the winner (`SPREAD`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Graph:
    """Modes of all ordered pairs: [i, j] takes view i into view j."""

    rotation: Float[Tensor, "N N K 3 3"]
    translation: Float[Tensor, "N N K 3"]
    vote: Float[Tensor, "N N K"]


def _graph(count: int, pairs: Int[Tensor, "Q 2"], modes: Modes) -> _Graph:
    """Modes in both directions; a vote is the squared margin, shared by the modes' scores."""
    k = modes.score.shape[1]
    rotation = torch.eye(3).to(modes.rotation).repeat(count, count, k, 1, 1)
    translation = modes.translation.new_zeros(count, count, k, 3)
    vote = modes.score.new_zeros(count, count, k)
    margin = (modes.score[:, 1] - modes.score[:, 0]).clamp_min(0).square()
    share = torch.softmax(-BETA * modes.score, -1) * margin[:, None]
    i, j = pairs.unbind(-1)
    rotation[i, j], rotation[j, i] = modes.rotation, modes.rotation.mT
    translation[i, j] = modes.translation
    translation[j, i] = -(modes.rotation.mT @ modes.translation[..., None])[..., 0]
    vote[i, j] = vote[j, i] = share
    return _Graph(rotation=rotation, translation=translation, vote=vote)


@torch.no_grad()
def synchronise(count: int, pairs: Int[Tensor, "Q 2"], modes: Modes) -> Synchronised:
    """The poses of all views that agree, the best of `ROOTS` starts by mean confidence.

    Args:
        count: Number of views N.
        pairs: Source and target of each registration, all or some of the pairs.
        modes: Of the pairs, target_T_source.
    """
    graph = _graph(count, pairs, modes)
    order = graph.vote.sum((1, 2)).topk(min(ROOTS, count)).indices
    tried = [_vote(graph, int(root)) for root in order]
    rotation, confidence = max(tried, key=lambda result: float(result[1].mean()))
    translation = _translations(graph, rotation)
    return Synchronised(rotation=rotation, translation=translation, confidence=confidence)


def _vote(graph: _Graph, root: int) -> tuple[Tensor, Tensor]:
    count = len(graph.vote)
    rotation = graph.rotation[:, root, 0].clone()
    known = graph.vote[:, root].sum(-1)
    known = known / known.max().clamp_min(TINY)
    known[root] = 1
    for _ in range(SWEEPS):
        old = rotation.clone()
        for i in range(count):
            rotation[i], known[i] = densest(
                (rotation[:, None] @ graph.rotation[i]).flatten(0, 1),
                (graph.vote[i] * known[:, None]).flatten(),
            )
        if bool(within((rotation * old).sum((-1, -2)), STILL).all()):
            break
    return rotation, known


def densest(proposals: Float[Tensor, "V 3 3"], vote: Float[Tensor, " V"]) -> tuple[Tensor, Tensor]:
    """The proposal with most votes about it, averaged over them, and their share."""
    kept = vote.topk(min(len(vote), PROPOSALS)).indices
    flat = proposals[kept].flatten(1)
    near = torch.exp(-SPREAD * (3 - flat @ flat.mT).clamp_min(0))  # 3 - trace = angle squared
    density = near @ vote[kept]
    best = density.argmax()
    weight = near[best] * vote[kept]
    mean = project_rotation((proposals[kept] * weight[:, None, None]).sum(0))
    return mean, density[best] / vote.sum().clamp_min(TINY)


def _translations(graph: _Graph, rotation: Tensor) -> Float[Tensor, "N 3"]:
    """Average of the translations that agreeing partners propose, iterated."""
    proposed = rotation[None, :, None] @ graph.rotation  # [i, j]: view i through view j
    agreeing = within((proposed * rotation[:, None, None]).sum((-1, -2)), DISTINCT)
    weight = graph.vote * agreeing
    turned = torch.einsum("jab,ijkb->ijka", rotation, graph.translation)
    translation = rotation.new_zeros(len(rotation), 3)
    total = weight.sum((1, 2)).clamp_min(TINY)[:, None]
    for _ in range(AVERAGED):
        votes = turned + translation[None, :, None]
        translation = (weight[..., None] * votes).sum((1, 2)) / total
    return translation
