# SPDX-License-Identifier: MIT
"""A small network in which points vote for the pose, in frames that turn with the cloud.

A plain point network is given a cloud in some frame and says where every point lies on the placed
template (template axes, this cloud's size and state), how sure it is, and which part it belongs to;
a weighted Procrustes step turns the votes into a pose. The frame is one of the four proper frames
of the cloud's principal axes, a set that does not change when the cloud is turned or moved; of
those the one whose points are surest wins. Learned towards the placements that search and bundle
adjustment found. It is asked where nobody knows the camera; elsewhere `view_network` is.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from scapo.geometry.points import MEAN_RADIUS, gather, k_nearest
from scapo.geometry.rigid import project_rotation
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import take
from scapo.registered.template import Placement

SIGNS = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))
"""Flips of the principal axes that keep the frame right-handed."""
FRAMES = len(SIGNS)  # Principal frames of a cloud
TURN = 0.15  # Rad: standard deviation of the turn away from a principal frame while learning
CAMERA_UNIT = 4.0  # Camera positions are learned in this many normalised units
WIDTH, NEIGHBOURS = 48, 12
"""Channels of the narrowest layer, and nearest points that the first one sees."""
POINT_SCALE, STEP_SCALE = 1 / MEAN_RADIUS, 8.0
"""By which coordinates, and offsets to neighbours, are brought to about 1."""
TINY, TINY_TRUST = 1e-9, 1e-6  # Least divisors: sums of weights of points, and of clouds
GOOD = 0.06
"""Normalised length within which a vote is good; sureness learns exp(-off^2 / (2 GOOD^2))."""
SMOOTH = 1e-6  # Squared normalised length within which the distance of votes is smooth
WEIGHTS = {"votes": 1.0, "sureness": 0.05, "part": 0.03, "state": 0.1, "size": 0.05, "camera": 0.2}
"""Of the terms of the loss: the votes make the pose, the others should not outweigh them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Votes:
    """What the network says of B clouds of K points in the frames it was given."""

    points: Float[Tensor, "B K 3"]
    """Each point on the placed template: template_R_view (x - t)."""
    sureness: Float[Tensor, "B K"]
    """Logit: whether the vote is good."""
    part: Float[Tensor, "B K P"]
    """Logits."""
    state: Float[Tensor, "B J"]
    log_scale: Float[Tensor, "B 3"]
    shift: Float[Tensor, "B J 3"]
    camera: Float[Tensor, "B 3"]
    """The camera's centre in the template frame."""


class PointVotes(nn.Module):
    """Edge features of neighbours, a point network with a global code, heads for the votes."""

    def __init__(self, parts: int, joints: int, *, width: int = WIDTH) -> None:
        super().__init__()
        self.joints = joints
        w = width
        self.edge = nn.Sequential(nn.Linear(3 * 3, w), nn.ReLU(), nn.Linear(w, w))
        self.local = _block(w + 3, 2 * w)
        self.wide = _block(2 * w, 4 * w)
        self.code = _block(2 * 4 * w, 4 * w)  # greatest and mean of all points
        self.mix = nn.Sequential(_block(w + 2 * w + 4 * w, 4 * w), _block(4 * w, 3 * w))
        self.vote = nn.Linear(3 * w, 3 + 1 + parts)
        self.whole = nn.Sequential(_block(4 * w, 2 * w), nn.Linear(2 * w, joints * 4 + 6))

    def forward(self, points: Float[Tensor, "B K 3"]) -> Votes:
        """Votes for clouds of mean radius 0.25 in their principal frames."""
        index = k_nearest(points, points, NEIGHBOURS)
        near = gather(points, index.flatten(1)).unflatten(1, index.shape[1:])
        step = STEP_SCALE * (near - points[:, :, None])
        here = (POINT_SCALE * points)[:, :, None].expand_as(step)
        edge = self.edge(torch.cat([step, here, step.square()], -1)).amax(2)  # (B, K, w)
        local = self.local(torch.cat([edge, POINT_SCALE * points], -1))  # (B, K, 2w)
        wide = self.wide(local)
        code = self.code(torch.cat([wide.amax(1), wide.mean(1)], -1))  # (B, 4w)
        spread = code[:, None].expand(-1, points.shape[1], -1)
        vote = self.vote(self.mix(torch.cat([edge, local, spread], -1)))
        whole = self.whole(code)
        j = self.joints
        return Votes(
            points=vote[..., :3],
            sureness=vote[..., 3],
            part=vote[..., 4:],
            state=whole[:, :j],
            log_scale=whole[:, j : j + 3],
            shift=whole[:, j + 3 : 4 * j + 3].unflatten(1, (j, 3)),
            camera=CAMERA_UNIT * whole[:, 4 * j + 3 :],
        )


def _block(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, outputs), nn.LayerNorm(outputs), nn.ReLU())


def principal_frames(points: Float[Tensor, "B K 3"]) -> Float[Tensor, "B 4 3 3"]:
    """The four right-handed frames of each centred cloud's principal axes (rows, longest first)."""
    _, vectors = torch.linalg.eigh(points.mT @ points)
    frame = vectors.flip(-1).mT
    frame = frame * torch.linalg.det(frame).sign()[:, None, None]
    signs = torch.tensor(SIGNS).to(points)
    return signs[:, :, None] * frame[:, None]


def random_frames(
    points: Float[Tensor, "B K 3"], generator: torch.Generator
) -> Float[Tensor, "B 3 3"]:
    """One of each cloud's principal frames, turned a little, to learn in.

    Args:
        points: Of each cloud.
        generator: On the device of the points.
    """
    device, count = points.device, len(points)
    pick = torch.randint(FRAMES, (count,), generator=generator, device=device)
    frames = principal_frames(points)[torch.arange(count, device=device), pick]
    turn = torch.randn(count, 3, generator=generator, device=device)
    return rotvec_to_rotmat(TURN * turn) @ frames


def own_frame(points: Float[Tensor, "B K 3"]) -> Float[Tensor, "B 3 3"]:
    """That of the principal frames along whose axes the cloud reaches farthest, by third moments.

    It turns with the cloud, as all four do together.
    """
    frames = principal_frames(points)
    skew = (points[:, None] @ frames.mT).pow(3).sum((-1, -2))
    return frames[torch.arange(len(points), device=points.device), skew.argmax(1)]


def procrustes(
    target: Float[Tensor, "B K 3"], source: Float[Tensor, "B K 3"], weight: Float[Tensor, "B K"]
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"]]:
    """Rotation R and translation t with target = R source + t, weighted least squares."""
    weight = (weight / weight.sum(-1, keepdim=True).clamp_min(TINY))[..., None]
    target_mean = (weight * target).sum(1)
    source_mean = (weight * source).sum(1)
    cross = ((target - target_mean[:, None]) * weight).mT @ (source - source_mean[:, None])
    rotation = project_rotation(cross)
    return rotation, target_mean - (rotation @ source_mean[..., None])[..., 0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """What the votes should be, for B clouds."""

    points: Float[Tensor, "B K 3"]
    part: Float[Tensor, "B K P"]
    """Weights."""
    state: Float[Tensor, "B J"]
    log_scale: Float[Tensor, "B 3"]
    shift: Float[Tensor, "B J 3"]
    camera: Float[Tensor, "B 3"]
    trust: Float[Tensor, " B"]
    """Weight of each cloud, in [0, 1]."""


def vote_losses(votes: Votes, target: Target) -> dict[str, Tensor]:
    """Distance of the votes (not squared: some targets are wrong), sureness, parts and the rest."""
    off = (votes.points - target.points).square().sum(-1)
    trust = target.trust / target.trust.sum().clamp_min(TINY_TRUST)
    good = torch.exp(-off.detach() / (2 * GOOD**2))
    sure = F.binary_cross_entropy_with_logits(votes.sureness, good, reduction="none").mean(1)
    part = -(target.part * votes.part.log_softmax(-1)).sum(-1).mean(1)
    state = (votes.state - target.state).abs().mean(1)
    size = (votes.log_scale - target.log_scale).abs().mean(1)
    size = size + (votes.shift - target.shift).abs().mean((1, 2))
    camera = (votes.camera - target.camera).abs().mean(1) / CAMERA_UNIT
    terms = {
        "votes": (off + SMOOTH).sqrt().mean(1),
        "sureness": sure,
        "part": part,
        "state": state,
        "size": size,
        "camera": camera,
    }
    return {name: (trust * (WEIGHTS[name] * value)).sum() for name, value in terms.items()}


def in_principal_frames(
    network: PointVotes, points: Float[Tensor, "B K 3"]
) -> tuple[Placement, Votes, Float[Tensor, "B 4"]]:
    """Placements from the four frames of each cloud, in a row, the votes, and how sure they are."""
    frames = principal_frames(points).flatten(0, 1)
    turned = points.repeat_interleave(FRAMES, 0) @ frames.mT
    votes = network(turned)
    weight = votes.sureness.sigmoid().square()
    rotation, translation = procrustes(turned, votes.points, weight)
    placement = Placement(
        rotation=frames.mT @ rotation,
        translation=(frames.mT @ translation[..., None])[..., 0],
        log_scale=votes.log_scale,
        state=votes.state,
        shift=votes.shift,
        deviation=torch.zeros_like(votes.shift),
    )
    return placement, votes, weight.mean(1).view(len(points), FRAMES)


def surest(
    network: PointVotes, points: Float[Tensor, "B K 3"]
) -> tuple[Placement, Votes, Float[Tensor, " B"]]:
    """The placement in the frame in which the network is surest, its votes, how sure it is."""
    placement, votes, sure = in_principal_frames(network, points)
    best = sure.argmax(1)
    row = torch.arange(len(points), device=points.device) * FRAMES + best
    return take(placement, row), take(votes, row), sure.gather(1, best[:, None])[:, 0]
