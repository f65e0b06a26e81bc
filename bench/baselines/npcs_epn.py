# SPDX-License-Identifier: MIT
"""NPCS-EPN, supervised: part coordinates by a rotation-equivariant network, poses by RANSAC.

Each point says which part it is of and where it lies in that part's canonical box (NPCS: Li et al.,
CVPR 2020); a similarity fitted inside RANSAC is the part's pose. The point network of the original
is replaced by EPN (`scapo.equivariant`), whose features are read off as invariants: coordinates in
a canonical frame do not change when the cloud is turned, so that nothing equivariant is left to
predict. Joints are votes of the points near an axis. The original, whose network is not
equivariant, has its points say directions in the camera's frame; here they are said in the frame of
the point's part and turned into the camera's by the pose that the part was found in.

Lengths are in units of four times the mean radius of the cloud.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.baselines.answers import Target, exchange, exchanged, states, turned_at_random
from bench.baselines.npcs_network import Answer, NetworkConfig, NpcsNetwork
from bench.baselines.similarity_ransac import Similarities, ransac
from scapo.categories import Category
from scapo.first_weights import initialise
from scapo.geometry.points import normalise
from scapo.geometry.rigid import apply, invert, point_line_distance, rigid
from scapo.method import (
    AbstractMethod,
    HalfCosine,
    Mode,
    Stage,
    Step,
    StepDecay,
    changes,
)
from scapo.paper.losses import least_costly
from scapo.ranges import Positive, Share
from scapo.records import either
from scapo.types import Joints, Labels, Observation, Prediction, Supervision

FEWEST = 8
"""Points that a part or a joint is found from at least, the likeliest if no more are its own."""
LOOKS = 4
"""Most clouds that a prediction deals."""
MARGIN = 1.1
"""Of the boxes over what the training clouds show."""
SMOOTH = 1e-6
"""Squared length under the root of a distance, which so has a gradient everywhere."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NpcsEpnConfig:
    """NPCS on EPN features, supervised; constants of the public code of ANCSH, EPN's sizes."""

    preset: Literal["paper", "cpu"] = "paper"
    """Where the other defaults come from."""
    points: int = 1024
    """Points that the network sees: random ones in training. A prediction deals the cloud into
    such clouds, asks up to four about all points by interpolation, and takes the mean."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Sizes of the network."""
    reach: Positive = 0.2
    """Distance from an axis within which points vote for it."""
    coordinate_weight: float = 10.0
    """Weight of the distance of the part coordinates."""
    segmentation_weight: float = 1.0
    """Weight of the cross entropy of the part labels."""
    offset_weight: float = 5.0
    """Weight of distance and direction to the axis."""
    axis_weight: float = 0.2
    """Weight of the axis's direction, and of the cross entropy of which joint is near."""
    either_order: bool = True
    """Take the labels or, where parts of the category are exchanged by a symmetry, the exchanged
    ones, whichever costs a cloud less: what the evaluation accepts."""
    rotated: Share = 0.5
    """Share of the clouds that are turned by a random rotation in a training step."""
    draws: int = 100
    """Samples of three points of RANSAC."""
    threshold: Positive = 0.1
    """Distance within which a point agrees with a pose, in diagonals of the part's box."""
    epochs: int = 200
    """Epochs of the one stage."""
    lr: float = 1e-3
    """Learning rate of Adam at the start."""
    min_lr: float = 1e-6
    """Least learning rate."""
    decay_every: int | None = 40
    """Epochs after which the rate is 0.7 of what it was (200,000 clouds of 5,000); None: half a
    cosine in place of steps."""
    weight_decay: float = 0.0
    """Added to the gradient."""
    batch: int = 16
    """Clouds a step."""


def cpu_config() -> NpcsEpnConfig:
    """The same with three narrow blocks on a quarter of the points."""
    return NpcsEpnConfig(
        preset="cpu",
        points=256,
        network=NetworkConfig(
            widths=(16, 32, 48),
            strides=(4, 2, 2),
            radii=(0.15, 0.3, 0.45),
            neighbours=(24, 16, 16),
            frames=4,
            code=32,
            head=(128, 96),
            recompute=False,
        ),
        rotated=0.0,
        epochs=12,
        lr=3e-3,
        decay_every=None,
    )


class NpcsEpn(AbstractMethod):
    """The method, for one category."""

    name: ClassVar[str] = "npcs-epn"
    networks = ("network",)
    box_centre: Tensor
    box_size: Tensor

    def __init__(
        self, config: NpcsEpnConfig, category: Category, generator: torch.Generator
    ) -> None:
        """Build the network and draw its weights.

        Args:
            config: Sizes, losses, stage.
            category: Fixes the parts, and which of them each joint links.
            generator: On the CPU; the only source of the initial weights.
        """
        super().__init__()
        self.config, self.category = config, category
        self.supervision: frozenset[Supervision] = frozenset({"pose", "segmentation", "joint"})
        self.least_points = FEWEST
        parts = len(category.parts)
        with torch.random.fork_rng(devices=[]):  # layers draw before `initialise` draws again
            self.network = NpcsNetwork(config.network, parts, len(category.joints))
        initialise(self, generator)
        self.register_buffer("box_centre", torch.zeros(parts, 3))
        self.register_buffer("box_size", torch.ones(parts))

    @property
    def variant(self) -> str:
        """The preset and the options that differ from it."""
        default = NpcsEpnConfig() if self.config.preset == "paper" else cpu_config()
        words = [] if self.config.preset == "paper" else [self.config.preset]
        leave = ["preset", "lr", "min_lr", "weight_decay", "decay_every", "network.recompute"]
        return "-".join(words + changes(self.config, default, leave=leave))

    def stages(self) -> tuple[Stage, ...]:
        """One, of Adam."""
        config = self.config
        schedule = HalfCosine()
        if config.decay_every is not None:
            schedule = StepDecay(every=config.decay_every, factor=0.7)
        return (
            Stage(
                name="learn",
                epochs=config.epochs,
                lr=config.lr,
                min_lr=config.min_lr,
                weight_decay=config.weight_decay,
                batch=config.batch,
                schedule=schedule,
            ),
        )

    @torch.no_grad()
    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Measure the canonical box of each part: that of its points in all training clouds.

        An instance's own box is no label. A part that is never seen keeps the unit box.

        Raises:
            ValueError: Labels are withheld.
        """
        del stage, generator
        points, target = self._normalised(observation, labels)
        for p in range(len(self.box_size)):
            some = [
                apply(invert(one.pose[:, p]), points)[one.part == p]
                for one in self._readings(target)
            ]
            seen = torch.cat(some)
            if len(seen):
                low, high = seen.amin(0), seen.amax(0)
                self.box_centre[p] = (low + high) / 2
                self.box_size[p] = MARGIN * (high - low).norm()

    def _readings(self, target: Target) -> list[Target]:
        """The truth, and what it is with the parts exchanged where a symmetry allows that."""
        if not self.config.either_order or self.category.symmetry is None:
            return [target]
        return [target, exchanged(target, target.pose.new_tensor(self.category.symmetry))]

    def _normalised(
        self, observation: Observation, labels: Labels
    ) -> tuple[Float[Tensor, "B N 3"], Target]:
        points, similarity = normalise(observation.points)
        return points, Target.of(labels, similarity, self.name)

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """Weighted terms, each cloud against the reading of its labels that costs it least.

        Raises:
            ValueError: Labels are withheld.
        """
        points, target = self._normalised(observation, labels)
        if self.training:
            config = self.config
            points, target = turned_at_random(
                points, target, config.points, config.rotated, step.generator
            )
        answer = self.network(points, points)
        found = [self._penalties(points, answer, one) for one in self._readings(target)]
        return least_costly(found)

    def _penalties(
        self, points: Float[Tensor, "B N 3"], answer: Answer, target: Target
    ) -> dict[str, Float[Tensor, " B"]]:
        """The terms for each cloud; points without a label count nowhere."""
        config = self.config
        known = target.part >= 0
        part = target.part.clamp_min(0)
        own = own_frame(target.pose, part)  # (B, N, 4, 4): part_T_cloud of each point
        place = apply(own, points[:, :, None])[:, :, 0]
        true = (place - self.box_centre[part]) / self.box_size[part][..., None] + 0.5
        said = answer.coordinate.take_along_dim(part[..., None, None], 2)[:, :, 0]
        coordinate = ((said - true).square().sum(-1) + SMOOTH).sqrt()
        entropy = F.cross_entropy(answer.part.mT, part, reduction="none")
        near = nearby(points, part, target, self.category, config.reach)
        close = known & (near.joint < len(self.category.joints))
        turn = own[..., :3, :3]
        towards, axis = (_turned(turn, x) for x in (near.towards, near.axis))
        offset = (answer.heat - near.heat).abs() + _apart(answer.towards, towards)
        joint = F.cross_entropy(answer.joint.mT, near.joint, reduction="none")
        return {
            "coordinate": config.coordinate_weight * _mean(coordinate, known),
            "segmentation": config.segmentation_weight * _mean(entropy, known),
            "offset": config.offset_weight * _mean(offset, close),
            "axis": config.axis_weight * _mean(_apart(answer.axis, axis), close),
            "joint": config.axis_weight * _mean(joint, known),
        }

    @torch.no_grad()
    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Parts, poses by RANSAC, joints by votes; there is one way for both modes."""
        del mode
        points, similarity = normalise(observation.points)
        answer = self.answer_all(points)
        poses = [self._pose(points, answer, p) for p in range(len(self.category.parts))]
        rotation = torch.stack([pose.rotation for pose in poses], 1)
        pose = rigid(rotation, torch.stack([pose.shift for pose in poses], 1))
        pivot, axis = self._joints(points, answer, rotation)
        base = rotation[:, 0]
        own = (axis[:, :, None] @ base[:, None])[:, :, 0]
        return Prediction(
            part_weight=answer.part.softmax(-1),
            camera_T_part=similarity.inverse_pose(pose),
            joints=Joints(
                pivot=similarity.inverse(pivot),
                axis=axis,
                state=states(pose, own, self.category, similarity.scale),
            ),
        )

    def answer_all(self, points: Float[Tensor, "B N 3"]) -> Answer:
        """The mean of what the network says of all points from each of the clouds dealt of them.

        Where parts exchange, each look may read the cloud in either order: all are brought to the
        one in which they name the parts as the first does.
        """
        hands = -(-points.shape[1] // self.config.points)
        dealt = [points[:, hand::hands] for hand in range(min(hands, LOOKS))]
        first, *others = (self.network(some, points) for some in dealt)
        looks = [first, *(self._as_first(first, look) for look in others)]
        return Answer(
            part=_mean_logits([look.part for look in looks]),
            coordinate=torch.stack([look.coordinate for look in looks]).mean(0),
            joint=_mean_logits([look.joint for look in looks]),
            heat=torch.stack([look.heat for look in looks]).mean(0),
            towards=F.normalize(torch.stack([look.towards for look in looks]).sum(0), dim=-1),
            axis=F.normalize(torch.stack([look.axis for look in looks]).sum(0), dim=-1),
        )

    def _as_first(self, first: Answer, look: Answer) -> Answer:
        """A look with the parts of each cloud exchanged where they are then more like the first's.

        Exchanged, a part has the frame of the other times the symmetry (`answers.exchanged`).
        """
        if not self.config.either_order or self.category.symmetry is None:
            return look
        order, joints, sign = exchange(len(self.category.parts))
        turn = look.coordinate.new_tensor(self.category.symmetry)
        size, centre = self.box_size[:, None], self.box_centre
        place = ((look.coordinate - 0.5) * size + centre)[..., order, :] @ turn
        other = Answer(
            part=look.part[..., order],
            coordinate=(place - centre) / size + 0.5,
            joint=look.joint[..., [*joints, len(joints)]],
            heat=look.heat,
            towards=look.towards @ turn,
            axis=sign * look.axis @ turn,
        )
        said = first.part.argmax(-1)
        alike = [(one.part.argmax(-1) == said).sum(1) for one in (look, other)]
        return either(alike[1] > alike[0], other, look)

    def _pose(self, points: Float[Tensor, "B N 3"], answer: Answer, p: int) -> Similarities:
        """Of one part, in the cloud, from the points that are most likely its own."""
        size = self.box_size[p]
        source = answer.coordinate[:, :, p] - 0.5 + self.box_centre[p] / size
        member = belonging(answer.part, p)
        config = self.config
        found = ransac(points / size, source, member, config.threshold, config.draws)
        return Similarities(scale=found.scale, rotation=found.rotation, shift=size * found.shift)

    def _joints(
        self, points: Float[Tensor, "B N 3"], answer: Answer, rotation: Float[Tensor, "B P 3 3"]
    ) -> tuple[Float[Tensor, "B J 3"], Float[Tensor, "B J 3"]]:
        """Pivots and axes: medians of the votes of the points that say a joint is near."""
        part = answer.part.argmax(-1)[..., None, None]
        turn = rotation.take_along_dim(part, 1)  # (B, N, 3, 3): cloud_R_part of each point
        axis, towards = (_turned(turn, x) for x in (answer.axis, answer.towards))
        place = points + towards * (1 - answer.heat[..., None]) * self.config.reach
        pivots, axes = [], []
        for j in range(len(self.category.joints)):
            near = belonging(answer.joint, j)
            pivots.append(median(place, near))
            axes.append(F.normalize(median(axis, near), dim=-1))
        return torch.stack(pivots, 1), torch.stack(axes, 1)


def _mean_logits(looks: list[Tensor]) -> Tensor:
    """Of the mean probabilities."""
    return torch.stack([look.softmax(-1) for look in looks]).mean(0).clamp_min(SMOOTH).log()


def own_frame(pose: Float[Tensor, "B P 4 4"], part: Int[Tensor, "B N"]) -> Float[Tensor, "B N 4 4"]:
    """part_T_cloud of the part of each point."""
    return invert(pose).take_along_dim(part[..., None, None], 1)


def _turned(
    rotation: Float[Tensor, "B N 3 3"], vector: Float[Tensor, "B N 3"]
) -> Float[Tensor, "B N 3"]:
    return (rotation @ vector[..., None])[..., 0]


def _apart(a: Float[Tensor, "B N 3"], b: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N"]:
    return ((a - b).square().sum(-1) + SMOOTH).sqrt()


def _mean(x: Float[Tensor, "B N"], counts: Bool[Tensor, "B N"]) -> Float[Tensor, " B"]:
    """Of the points that count; 0 where none does."""
    return torch.where(counts, x, 0).sum(1) / counts.sum(1).clamp_min(1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Nearby:
    """The axis near each point, in the frame of the points."""

    joint: Int[Tensor, "B N"]
    """Its number; one more than the last where none is near."""
    heat: Float[Tensor, "B N"]
    towards: Float[Tensor, "B N 3"]
    """Unit vector to the nearest point of the axis; any for a point on it."""
    axis: Float[Tensor, "B N 3"]


def nearby(
    points: Float[Tensor, "B N 3"],
    part: Int[Tensor, "B N"],
    target: Target,
    category: Category,
    reach: float,
) -> Nearby:
    """The nearest axis of a joint of each point's own part, within the reach."""
    pivot, axis = target.pivot[:, None], target.axis[:, None]  # (B, 1, J, 3)
    step = pivot - points[:, :, None]
    step = step - (step * axis).sum(-1, keepdim=True) * axis  # at right angles to the axis
    distance = point_line_distance(points[:, :, None], pivot, axis)  # (B, N, J)
    linked = torch.zeros(len(category.parts), len(category.joints), dtype=torch.bool)
    for j, joint in enumerate(category.joints):
        linked[joint.parent, j] = linked[joint.child, j] = True
    distance = torch.where(linked.to(part.device)[part], distance, torch.inf)
    least, which = distance.min(-1)
    number = len(category.joints)
    pick = which[..., None, None]
    return Nearby(
        joint=torch.where(least < reach, which, number),
        heat=(1 - least / reach).clamp_min(0),
        towards=F.normalize(step.take_along_dim(pick, 2)[:, :, 0], dim=-1),
        axis=axis.expand_as(step).take_along_dim(pick, 2)[:, :, 0],
    )


def belonging(logits: Float[Tensor, "B N K"], which: int) -> Bool[Tensor, "B N"]:
    """Points whose likeliest class this is, and in any case the FEWEST where it is likeliest."""
    own = logits.argmax(-1) == which
    score = logits.log_softmax(-1)[..., which]
    likeliest = score.topk(min(FEWEST, logits.shape[1]), 1).indices
    return own.scatter(1, likeliest, torch.ones_like(likeliest, dtype=torch.bool))


def median(x: Float[Tensor, "B N 3"], counts: Bool[Tensor, "B N"]) -> Float[Tensor, "B 3"]:
    """Of each coordinate over the points that count."""
    return torch.where(counts[..., None], x, torch.nan).nanmedian(1).values
