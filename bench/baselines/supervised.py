# SPDX-License-Identifier: MIT
"""What the supervised baselines share: heads on a point network, targets, losses, prediction.

A body turns a cloud into features per point and one code; everything after it is here, so that the
baselines differ in their bodies alone. Points vote for the pose: each says where it lies in the
frame of every part, and a Procrustes step turns the votes into a rotation and a translation (the
nearest rotation of a 3 x 3 matrix, so no axis of a pair is favoured as by Gram-Schmidt). The
alternative `pooled` is what pose regression usually is: two axis vectors by Gram-Schmidt and an
offset from the part's mean, from features pooled over the part. Joints are said in the frame of the
base and placed by its pose; states are read off the poses of the two parts.

Lengths are in units of twice the mean radius: the cloud is centred with mean radius 0.5.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from bench.baselines.answers import (
    Answer,
    Target,
    as_seen_by,
    exchanged,
    mean_pose,
    poses_of,
    states,
    turned_at_random,
)
from bench.baselines.body import Block, Body, Features
from scapo.categories import Category
from scapo.first_weights import initialise
from scapo.geometry.numerics import at_least_float32
from scapo.geometry.points import MEAN_RADIUS, normalise
from scapo.geometry.rigid import apply, gram_schmidt, invert, rigid
from scapo.method import AbstractMethod, Mode, Stage, Step, changes
from scapo.paper.losses import least_costly
from scapo.ranges import Share
from scapo.types import Joints, Labels, Observation, Prediction, Supervision

RADIUS = 0.5
"""Mean distance of a cloud's points from their centroid, as bodies see them."""
GROW = RADIUS / MEAN_RADIUS
SMOOTH = 1e-4
"""Squared length under the root of a distance, which so has a gradient everywhere."""
BEND = 0.05
"""Length up to which the smooth L1 losses are quadratic."""
TINY = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningConfig:
    """Heads, augmentation and training of a supervised baseline."""

    pose: Literal["votes", "pooled"] = "votes"
    """How part poses are found: by votes of all points, or regressed from pooled features."""
    width: int = 128
    """Channels of the hidden layer of each head."""
    dropout: Share = 0.5
    """Share of the features that the segmentation does not see in a training step."""
    either_order: bool = True
    """Take the labels or, where parts of the category are exchanged by a symmetry, the exchanged
    ones, whichever costs a cloud less: what the evaluation accepts."""
    rotated: Share = 0.5
    """Share of the clouds that are turned by a random rotation in a training step."""
    noisy: Share = 0.5
    """Share of the clouds that get noise in a training step."""
    noise: float = 1e-3
    """Standard deviation of the noise, in units of twice the mean radius."""
    points: int | None = None
    """Points that the network sees at a time: random ones in training; a prediction goes over all
    points in clouds of at most so many. None: all."""
    segmentation_weight: float = 1.0
    """Weight of the cross entropy of the part labels."""
    pose_weight: float = 5.0
    """Weight of the distance of the votes, or of rotation and translation when pooled."""
    pivot_weight: float = 5.0
    """Weight of the smooth L1 distance of the pivot."""
    axis_weight: float = 1.0
    """Weight of 1 - cos of the angle between the axes."""
    epochs: int = 200
    """Epochs of the one stage."""
    lr: float = 1e-3
    """Learning rate of Adam at the start, on half a cosine from there."""
    min_lr: float = 1e-6
    """Learning rate at the end."""
    weight_decay: float = 1e-8
    """Added to the gradient."""
    batch: int = 16
    """Clouds a step."""


LEAN = LearningConfig(points=128, dropout=0.0, rotated=0.0, epochs=30, lr=2e-3, batch=32)
"""Of the `cpu` presets: 12 to 15 minutes of one core for 5,000 clouds."""


class Heads(nn.Module):
    """Features to an answer."""

    def __init__(self, body: Body, category: Category, config: LearningConfig) -> None:
        super().__init__()
        self.config = config
        self.parts, self.joints = len(category.parts), len(category.joints)
        width = config.width
        self.segment = nn.Linear(body.features, self.parts)
        if config.pose == "votes":
            self.vote = nn.Sequential(Block(body.features, width), nn.Linear(width, 3 * self.parts))
        else:
            self.regress = _two_layers(body.features + body.code, width, 9)
        self.joint = _two_layers(body.code, width, 6 * self.joints)

    def forward(
        self,
        points: Float[Tensor, "B N 3"],
        features: Features,
        generator: torch.Generator | None,
    ) -> Answer:
        """With dropout where a generator is given."""
        x = features.points
        kept = x
        if generator is not None and self.config.dropout:
            draw = torch.rand(x.shape, generator=generator, device=x.device)
            kept = x * (draw >= self.config.dropout) / (1 - self.config.dropout)
        part = at_least_float32(self.segment(kept))
        joint = at_least_float32(self.joint(features.code)).unflatten(1, (self.joints, 6))
        pivot, axis = joint.split(3, -1)
        votes = pose = None
        if self.config.pose == "votes":
            votes = at_least_float32(self.vote(x)).unflatten(-1, (self.parts, 3))
        else:
            pose = self._pooled(points, features, part)
        return Answer(part=part, votes=votes, pose=pose, pivot=pivot, axis=axis)

    def _pooled(
        self, points: Float[Tensor, "B N 3"], features: Features, part: Float[Tensor, "B N P"]
    ) -> Float[Tensor, "B P 4 4"]:
        """Rotation and offset from the part's mean, from features weighted by the segmentation."""
        weight = part.detach().softmax(-1)
        weight = weight / weight.sum(1, keepdim=True).clamp_min(TINY)  # (B, N, P)
        pooled = weight.mT @ at_least_float32(features.points)  # (B, P, C)
        code = at_least_float32(features.code)[:, None].expand(-1, self.parts, -1)
        out = at_least_float32(self.regress(torch.cat([pooled, code], -1)))
        return rigid(gram_schmidt(out[..., :3], out[..., 3:6]), weight.mT @ points + out[..., 6:])


def _two_layers(inputs: int, width: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, outputs))


def penalties(
    points: Float[Tensor, "B N 3"], answer: Answer, target: Target, config: LearningConfig
) -> dict[str, Float[Tensor, " B"]]:
    """The weighted terms of the loss for each cloud; points without a label count nowhere.

    The pivot is compared with the point of the true axis nearest to the origin of the base.
    """
    known = (target.part >= 0).to(points.dtype)
    count = known.sum(1).clamp_min(1)
    entropy = F.cross_entropy(
        answer.part.mT, target.part, ignore_index=-1, reduction="none"
    ).sum(1)  # fmt: skip
    terms = {"segmentation": config.segmentation_weight * entropy / count}
    if answer.votes is not None:
        true = apply(invert(target.pose), points[:, None]).transpose(1, 2)  # (B, N, P, 3)
        off = ((answer.votes - true).square().sum(-1) + SMOOTH).sqrt().mean(-1)
        terms["votes"] = config.pose_weight * (known * off).sum(1) / count
    if answer.pose is not None:
        turn = (answer.pose - target.pose)[..., :3, :3].abs().mean((1, 2, 3))
        shift = _smooth(answer.pose[..., :3, 3], target.pose[..., :3, 3])
        terms |= {"rotation": config.pose_weight * turn, "translation": config.pose_weight * shift}
    base = invert(target.pose[:, 0])
    axis = target.axis @ base[:, :3, :3].mT
    pivot = apply(base, target.pivot)
    pivot = pivot - (pivot * axis).sum(-1, keepdim=True) * axis
    cosine = F.cosine_similarity(answer.axis, axis, dim=-1)
    return terms | {
        "pivot": config.pivot_weight * _smooth(answer.pivot, pivot),
        "axis": config.axis_weight * (1 - cosine).mean(1),
    }


def _smooth(found: Float[Tensor, "B K 3"], true: Float[Tensor, "B K 3"]) -> Float[Tensor, " B"]:
    return F.smooth_l1_loss(found, true, beta=BEND, reduction="none").sum(-1).mean(1)


class SupervisedMethod(AbstractMethod, ABC):
    """A body, the heads and their training; a baseline says which body."""

    networks = ("body",)
    learning: LearningConfig

    def __init__(
        self,
        config: Any,  # noqa: ANN401 - the baseline's, which holds `learning`
        category: Category,
        make_body: Callable[[], Body],
        generator: torch.Generator,
    ) -> None:
        """Build body and heads and draw their weights.

        Args:
            config: With a `preset` and a `learning`.
            category: Fixes the number of parts and joints.
            make_body: Called once.
            generator: On the CPU; the only source of the initial weights.
        """
        super().__init__()
        self.config, self.learning, self.category = config, config.learning, category
        self.supervision: frozenset[Supervision] = frozenset({"pose", "segmentation", "joint"})
        with torch.random.fork_rng(devices=[]):  # layers draw before `initialise` draws again
            self.body = make_body()
            self.heads = Heads(self.body, category, config.learning)
        self.least_points = self.body.least_points
        initialise(self, generator)

    @property
    @abstractmethod
    def default(self) -> Any:  # noqa: ANN401 - of the configuration's type
        """The configuration of the preset that this one started from."""

    @property
    def variant(self) -> str:
        """The preset and the options that differ from it."""
        words = [] if self.config.preset == "paper" else [self.config.preset]
        leave = [f"learning.{name}" for name in ("lr", "min_lr", "weight_decay")]
        return "-".join(words + changes(self.config, self.default, leave=["preset", *leave]))

    def stages(self) -> tuple[Stage, ...]:
        """One, of Adam on half a cosine."""
        learning = self.learning
        return (
            Stage(
                name="learn",
                epochs=learning.epochs,
                lr=learning.lr,
                min_lr=learning.min_lr,
                weight_decay=learning.weight_decay,
                batch=learning.batch,
            ),
        )

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Nothing to prepare."""
        del stage, observation, labels, generator

    @property
    def either_order(self) -> bool:
        """Whether a symmetry exchanges parts of the category, and the network may take either."""
        return self.learning.either_order and self.category.symmetry is not None

    def answer(self, points: Float[Tensor, "B N 3"], generator: torch.Generator | None) -> Answer:
        """Run body and heads."""
        return self.heads(points, self.body(points, generator), generator)

    def answer_all(self, points: Float[Tensor, "B N 3"]) -> Answer:
        """The answer for all points, from clouds as thin as those of the training.

        The cloud is dealt like cards; what each hand says of the whole is averaged, once all name
        the parts as the first does.
        """
        number = points.shape[1]
        hands = -(-number // (self.learning.points or number))
        dealt = [torch.arange(hand, number, hands, device=points.device) for hand in range(hands)]
        answers = [self.answer(points[:, some], None) for some in dealt]
        answers = [replace(answer, axis=F.normalize(answer.axis, dim=-1)) for answer in answers]
        if hands > 1 and self.either_order:
            symmetry = points.new_tensor(self.category.symmetry)
            first = poses_of(points[:, dealt[0]], answers[0])
            answers = [
                as_seen_by(first, points[:, some], answer, symmetry)
                for some, answer in zip(dealt, answers, strict=True)
            ]
        back = torch.cat(dealt).argsort()
        votes = [answer.votes for answer in answers if answer.votes is not None]
        poses = [answer.pose for answer in answers if answer.pose is not None]
        return Answer(
            part=torch.cat([answer.part for answer in answers], 1)[:, back],
            votes=torch.cat(votes, 1)[:, back] if votes else None,
            pose=mean_pose(torch.stack(poses)) if poses else None,
            pivot=torch.stack([answer.pivot for answer in answers]).mean(0),
            axis=torch.stack([answer.axis for answer in answers]).mean(0),
        )

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """Weighted terms for a batch of clouds, turned and disturbed while training.

        Raises:
            ValueError: Labels are withheld.
        """
        points, target = self._normalised(observation, labels)
        if self.training:
            points, target = augmented(points, target, self.learning, step.generator)
        answer = self.answer(points, step.generator if self.training else None)
        targets = [target]
        if self.either_order:
            targets.append(exchanged(target, points.new_tensor(self.category.symmetry)))
        return least_costly([penalties(points, answer, one, self.learning) for one in targets])

    def _normalised(
        self, observation: Observation, labels: Labels
    ) -> tuple[Float[Tensor, "B N 3"], Target]:
        """Clouds of mean radius 0.5, and the labels in their frame."""
        points, similarity = normalise(observation.points)
        return GROW * points, Target.of(labels, similarity, self.name, GROW)

    @torch.no_grad()
    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Parts, poses and joints; there is one way for both modes."""
        del mode
        points, similarity = normalise(observation.points)
        answer = self.answer_all(GROW * points)
        pose = poses_of(GROW * points, answer)
        axis, base = F.normalize(answer.axis, dim=-1), pose[:, 0]
        pivot = apply(base, answer.pivot)
        metric = pose.clone()
        metric[..., :3, 3] = similarity.inverse(pose[..., :3, 3] / GROW)
        return Prediction(
            part_weight=answer.part.softmax(-1),
            camera_T_part=metric,
            joints=Joints(
                pivot=similarity.inverse(pivot / GROW),
                axis=axis @ base[:, :3, :3].mT,
                state=states(pose, axis, self.category, GROW * similarity.scale),
            ),
        )


def augmented(
    points: Float[Tensor, "B N 3"],
    target: Target,
    config: LearningConfig,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "B K 3"], Target]:
    """Some of the points, some clouds turned with their truth and some disturbed."""
    points, target = turned_at_random(points, target, config.points, config.rotated, generator)
    draw = {"generator": generator, "device": points.device}
    disturbed = torch.rand(len(points), 1, 1, **draw) < config.noisy
    noise = config.noise * torch.randn(points.shape, dtype=points.dtype, **draw)
    return points + noise * disturbed, target
