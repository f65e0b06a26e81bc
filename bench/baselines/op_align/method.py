# SPDX-License-Identifier: MIT
"""OP-Align: align the object by one of 60 poses, then its parts by joints, to a canonical shape.

Che et al., "OP-Align: Object-level and Part-level Alignment for Self-supervised Category-level
Articulated Object Pose Estimation", ECCV 2024; docs/methods.md says what differs. No label is used
unless `supervision` asks for it.

Frames: `camera` in metres; `input`, the cloud centred and scaled to mean radius 0.25; `aligned`,
R^T x - t under the chosen hypothesis; `canonical`, the decoder's shape.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from bench.baselines.op_align import losses
from bench.baselines.op_align.backbone import Backbone, BackboneConfig
from bench.baselines.op_align.heads import (
    Articulation,
    CanonicalShape,
    Decoder,
    DecoderConfig,
    Hypotheses,
    HypothesisConfig,
    HypothesisHead,
    PointNetConfig,
    PointNetwork,
)
from scapo.categories import Category, JointKind
from scapo.first_weights import initialise
from scapo.geometry.points import Similarity, normalise
from scapo.geometry.rigid import apply, random_rotations, rigid
from scapo.method import AbstractMethod, Mode, Stage, Step, StepDecay, changes
from scapo.paper.heads import opalign_record, thin
from scapo.paper.losses import labelled, shape_variance, state_gauge
from scapo.paper.skinning import cross_maps, part_maps
from scapo.pictures import Panel, PictureData
from scapo.ranges import Neighbours, Share
from scapo.types import Joints, Labels, Observation, Prediction

GREY = 0.5
"""The colour of points without one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LossConfig:
    """Weights of the terms; defaults as published."""

    reconstruction: float = 10.0
    """Weight of L_rigid and L_art, which share it."""
    rigid_share: Share = 0.5
    """Share of L_rigid at the beginning, the rest is L_art's; halved with the learning rate."""
    density: float = 200.0
    """Weight of how unevenly the canonical points lie: the variance of neighbour distances."""
    density_neighbours: Neighbours = 64
    """Neighbours of a point that tell how densely it lies."""
    offset: float = 10.0
    """Weight of the decoder's offsets from the base shape."""
    centroid: float = 1.0
    """Weight of the squared distance of the shape's centroid from the origin."""
    gauge: float = 10.0
    """Weight of states of the canonical shape near 0, its axes the same for all clouds."""
    pivot: float = 0.1
    """Weight of pivots near points, of either shape."""
    same_turn: float = 1.0
    """With three parts: weight of the turns between the axes of both shapes being alike."""
    same_base: float = 10.0
    """With three parts: weight of the base being mapped alike by either joint."""
    attention: float = 1.0
    """Weight of the expected distance under the attention."""
    translation: float = 1.0
    """Weight of the chosen hypothesis's squared translation."""
    part_share: float = 10.0
    """Weight of parts that are empty and of points that belong to one part alone."""
    labelled_segmentation: float = 1.0
    """Used with `supervision` segmentation only."""
    labelled_joints: float = 1.0
    """Used with `supervision` joint only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OpAlignConfig:
    """OP-Align, without labels; the defaults are the published values."""

    preset: Literal["paper", "cpu"] = "paper"
    """Where the other defaults come from."""
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    """Sizes of the equivariant backbone."""
    hypotheses: HypothesisConfig = field(default_factory=HypothesisConfig)
    """Sizes of the pose head."""
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    """Sizes of the decoder."""
    point_net: PointNetConfig = field(default_factory=PointNetConfig)
    """Sizes of the network that segments and finds joints."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Weights of the loss terms."""
    supervision: tuple[Literal["segmentation", "joint"], ...] = ()
    """Labels that training may see: both in Table 2, OP-Align (SJ)."""
    color: bool = True
    """Show the network the colours that the data have; else, and without any, all is grey."""
    color_weight: float = 0.0
    """Weight of colours in distances; the decoder then has a colour branch. 0 in the published
    runs."""
    points: int | None = None
    """Points of every cloud that a training step draws anew; None = all."""
    chosen_by: int | None = None
    """Points of the cloud that choose the hypothesis; None = all."""
    direction_noise: float = 0.01
    """Width of the uniform noise on axes in training."""
    test_noise: bool = False
    """Noise on axes at test time too, as published."""
    turned: Share = 0.0
    """Share of the training clouds that are turned at random (published: real data, 0.5)."""
    noise: float = 0.0
    """Noise of coordinates in training, normalised units (published: real data, 1e-3 on half)."""
    epochs: int = 64
    """20,000 steps of 16 clouds where there are 5,000."""
    decay_every: int = 16
    """Epochs after which the learning rate and `loss.rigid_share` are halved (5,000 steps)."""
    lr: float = 1e-4
    """Learning rate at the start."""
    min_lr: float = 1e-6
    """Least learning rate."""
    weight_decay: float = 1e-8
    """Added to the gradient, times the weights."""
    batch: int = 16
    """Clouds a step."""


def cpu_config() -> OpAlignConfig:
    """The lean preset: the same structure with fewer points and channels."""
    return OpAlignConfig(
        preset="cpu",
        backbone=BackboneConfig(channels=(8, 16, 32, 64), radius=0.25, neighbours=16, points=128),
        hypotheses=HypothesisConfig(
            pooled=32, width=128, hidden=32, code=64, residual_range=math.pi / 4
        ),
        decoder=DecoderConfig(width=128, points=256),
        point_net=PointNetConfig(width=48, blocks=5, segmentation=(32, 16), joint=(64, 32)),
        loss=LossConfig(density_neighbours=16),
        points=256,
        chosen_by=96,
        epochs=8,
        decay_every=2,
        lr=1e-3,
    )


UNNAMED = frozenset({"preset", "supervision", "lr", "min_lr", "weight_decay"})
"""Options with names of their own in a variant, or that make no other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """All that the networks say of a batch of clouds, in normalised units."""

    hypotheses: Hypotheses
    distance: Float[Tensor, "B K"]
    """Of the cloud from the shape under each hypothesis, without gradient."""
    rotation: Float[Tensor, "B 3 3"]
    """Of the chosen hypothesis, input_R_aligned."""
    translation: Float[Tensor, "B 3"]
    """aligned = R^T x - t."""
    aligned: Float[Tensor, "B N 3"]
    color: Float[Tensor, "B N 3"]
    shape: CanonicalShape
    observed: Articulation
    """Of the aligned cloud."""
    canonical: Articulation
    """Of the canonical shape."""

    def place(self, points: Float[Tensor, "B K 3"]) -> Float[Tensor, "B K 3"]:
        """Aligned coordinates to the input frame."""
        return (points + self.translation[:, None]) @ self.rotation.mT


class OpAlign(AbstractMethod):
    """The method, for one category."""

    name: ClassVar[str] = "op-align"
    networks = ("backbone", "head", "decoder", "point_network")
    least_batch = 2  # norms of the layers on codes, one a cloud

    def __init__(
        self, config: OpAlignConfig, category: Category, generator: torch.Generator
    ) -> None:
        """Build the networks and draw their weights.

        Args:
            config: Sizes, losses, stages.
            category: Fixes the number of parts and the kind of each joint, nothing else.
            generator: On the CPU; the only source of the initial weights.
        """
        super().__init__()
        self.config = config
        self.category = category
        self.supervision = frozenset(config.supervision)
        self.kinds: tuple[JointKind, ...] = tuple(joint.kind for joint in category.joints)
        color = config.color_weight > 0
        with torch.random.fork_rng(devices=[]):  # layers draw before `initialise` draws again
            self.backbone = Backbone(config.backbone, config.hypotheses.pooled)
            self.head = HypothesisHead(
                config.hypotheses, self.backbone.outputs, self.backbone.anchors
            )
            self.decoder = Decoder(config.decoder, config.hypotheses.code, color=color)
            self.point_network = PointNetwork(config.point_net, category)
        initialise(self, generator)

    @property
    def variant(self) -> str:
        """The preset, S and J for the labels used, and other options."""
        config = self.config
        preset = OpAlignConfig() if config.preset == "paper" else cpu_config()
        words = [] if config.preset == "paper" else [config.preset]
        words += ["".join(sorted((label[0].upper() for label in config.supervision), reverse=True))]
        words += changes(config, preset, leave=UNNAMED)
        return "-".join(word for word in words if word)

    def stages(self) -> tuple[Stage, ...]:
        """One stage of Adam, its rate halved in steps."""
        config = self.config
        return (
            Stage(
                name="align",
                epochs=config.epochs,
                lr=config.lr,
                min_lr=config.min_lr,
                weight_decay=config.weight_decay,
                batch=config.batch,
                schedule=StepDecay(every=config.decay_every, factor=0.5),
            ),
        )

    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Nothing to prepare."""
        del stage, observation, labels, generator

    def explain(
        self, points: Float[Tensor, "B N 3"], color: Float[Tensor, "B N 3"], noise: Tensor | None
    ) -> Alignment:
        """Run every network on clouds in the input frame.

        Args:
            points: Of the clouds.
            color: Of the points.
            noise: (2, B, J, 3), added to the axes of both shapes, or None.
        """
        hypotheses = self.head(self.backbone(points, color))
        shape = self.decoder(hypotheses.code)
        distance = self._distances(points, color, hypotheses, shape)
        rows = torch.arange(points.shape[0], device=points.device)
        best = distance.argmin(-1)
        rotation, translation = (
            hypotheses.rotation[rows, best],
            hypotheses.translation[rows, best],
        )
        aligned = points @ rotation - translation[:, None]
        observed, canonical = self.point_network(aligned, shape.points)
        if noise is not None:
            observed, canonical = (
                _disturbed(one, more)
                for one, more in zip((observed, canonical), noise, strict=True)
            )
        return Alignment(
            hypotheses=hypotheses,
            distance=distance,
            rotation=rotation,
            translation=translation,
            aligned=aligned,
            color=color,
            shape=shape,
            observed=observed,
            canonical=canonical,
        )

    @torch.no_grad()
    def _distances(
        self,
        points: Float[Tensor, "B N 3"],
        color: Float[Tensor, "B N 3"],
        hypotheses: Hypotheses,
        shape: CanonicalShape,
    ) -> Float[Tensor, "B K"]:
        """How badly each hypothesis fits."""
        count = self.config.chosen_by or points.shape[1]
        few = thin(points, count)
        aligned = few[:, None] @ hypotheses.rotation - hypotheses.translation[:, :, None]
        canonical = shape.points
        if shape.color is not None:
            tint = self.config.color_weight * thin(color, count)
            aligned = torch.cat([aligned, tint[:, None].expand_as(aligned)], -1)
            canonical = torch.cat([canonical, self.config.color_weight * shape.color], -1)
        return losses.hypothesis_distances(aligned, canonical)

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """The terms for a batch, times their weights."""
        observation, labels = self._drawn(observation, labels, step.generator)
        points, similarity = normalise(observation.points)
        turn = self._turns(points, step.generator)
        points = points @ turn.mT
        if self.config.noise:
            points = points + self.config.noise * _normal(points, step.generator)
        noise = self._axis_noise(points, step.generator)
        e = self.explain(points, self._colors(observation), noise)
        done = int(step.progress * self.config.epochs + 1e-6) // self.config.decay_every
        terms = self._reconstruction(e, self.config.loss.rigid_share * 0.5**done)
        terms |= self._regularisers(e)
        return terms | self._labelled(e, labels, similarity, turn)

    def _drawn(
        self, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> tuple[Observation, Labels]:
        """Some points of every cloud with their colours and parts."""
        count, total = self.config.points, observation.points.shape[1]
        if count is None or count >= total:
            return observation, labels
        order = torch.randperm(total, generator=generator, device=generator.device)[:count]
        color, part = observation.color, labels.part
        return (
            replace(
                observation,
                points=observation.points[:, order],
                color=None if color is None else color[:, order],
            ),
            replace(labels, part=None if part is None else part[:, order]),
        )

    def _turns(
        self, points: Float[Tensor, "B N 3"], generator: torch.Generator
    ) -> Float[Tensor, "B 3 3"]:
        """A random rotation for the share of the clouds that is turned."""
        number = points.shape[0]
        turn = torch.eye(3, dtype=points.dtype, device=points.device).repeat(number, 1, 1)
        if not self.config.turned:
            return turn
        drawn = torch.rand(number, generator=generator, device=generator.device)
        rotation = random_rotations(number, generator, dtype=points.dtype)
        return torch.where((drawn < self.config.turned)[:, None, None], rotation, turn)

    def _axis_noise(
        self, points: Float[Tensor, "B N 3"], generator: torch.Generator
    ) -> Tensor | None:
        """Uniform noise on the axes of both shapes."""
        if not self.config.direction_noise:
            return None
        size = (2, points.shape[0], len(self.kinds), 3)
        drawn = torch.rand(size, generator=generator, device=generator.device, dtype=points.dtype)
        return self.config.direction_noise * (drawn - 0.5)

    def _colors(self, observation: Observation) -> Float[Tensor, "B N 3"]:
        """Those of the data, or grey."""
        if self.config.color and observation.color is not None:
            return observation.color
        return torch.full_like(observation.points, GREY)

    def _reconstruction(self, e: Alignment, share: float) -> dict[str, Tensor]:
        """L_rigid and L_art, and where three parts are, that their two maps of the base agree."""
        config, shape = self.config.loss, e.shape.points
        source, target = e.observed.joints, e.canonical.joints
        maps = cross_maps(source, target, self.kinds)  # (B, J, 2, 4, 4)
        base = apply(maps[:, :, 0], e.aligned[:, None])  # (B, J, N, 3)
        moved = torch.cat([base.mean(1, keepdim=True), apply(maps[:, :, 1], e.aligned[:, None])], 1)
        if e.shape.color is not None:
            weight = self.config.color_weight
            tint = (weight * e.color)[:, None].expand_as(moved)
            moved = torch.cat([moved, tint], -1)
            shape = torch.cat([shape, weight * e.shape.color], -1)
        art = losses.articulated(moved, shape, e.observed.weights, e.canonical.weights)
        terms = {
            "rigid": share * config.reconstruction * losses.rigid(e.aligned, e.shape.points),
            "art": (1 - share) * config.reconstruction * art,
        }
        if len(self.kinds) > 1:
            terms["same_turn"] = config.same_turn * losses.same_turn(source, target)
            terms["same_base"] = config.same_base * losses.same_base(base[:, 0], base[:, 1])
        return terms

    def _regularisers(self, e: Alignment) -> dict[str, Tensor]:
        """Everything that holds the canonical shape, the joints and the hypotheses."""
        config, points = self.config.loss, e.shape.points
        joints = e.canonical.joints
        neighbours = min(config.density_neighbours, points.shape[1] - 1)
        pivots = losses.pivot_near_points(joints.pivot, points)
        pivots = pivots + losses.pivot_near_points(e.observed.joints.pivot, e.aligned)
        parts = losses.part_share(e.observed.weights, e.canonical.weights)
        return {
            "density": config.density * losses.density(points, neighbours),
            "offset": config.offset * shape_variance(e.shape.offset),
            "centroid": config.centroid * losses.centroid(points),
            "gauge": config.gauge * state_gauge(joints.state, joints.axis),
            "pivot": config.pivot * pivots,
            "attention": config.attention * losses.attention(e.hypotheses.attention, e.distance),
            "translation": config.translation * e.translation.square().sum(-1).mean(),
            "part_share": config.part_share * parts,
        }

    def _labelled(
        self, e: Alignment, labels: Labels, similarity: Similarity, turn: Float[Tensor, "B 3 3"]
    ) -> dict[str, Tensor]:
        """The supervised terms of Table 2's variant, on the aligned cloud."""
        config, found = self.config.loss, e.observed.joints
        if labels.joints is not None:
            pivot = similarity.forward(labels.joints.pivot) @ turn.mT
            axis = labels.joints.axis @ turn.mT
            labels = replace(labels, joints=replace(labels.joints, pivot=pivot, axis=axis))
        joints = e.place(found.pivot), found.axis @ e.rotation.mT
        scales = config.labelled_segmentation, config.labelled_joints
        return labelled(e.observed.weights, joints, labels, self.category, scales)

    @torch.no_grad()
    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Parts of the aligned cloud, its joints, and the canonical shape's parts carried onto it.

        States are those of the cloud minus the canonical shape's.
        """
        del mode
        points, similarity = normalise(observation.points)
        noise = None
        if self.config.test_noise:
            generator = torch.Generator(points.device).manual_seed(0)
            noise = self._axis_noise(points, generator)
        e = self.explain(points, self._colors(observation), noise)
        joints, canonical = e.observed.joints, e.canonical.joints
        place = rigid(e.rotation, (e.rotation @ e.translation[..., None])[..., 0])
        pose = place[:, None] @ part_maps(cross_maps(canonical, joints, self.kinds))
        state = joints.relative() - canonical.relative()
        scale = similarity.scale[:, None]
        return Prediction(
            part_weight=e.observed.weights,
            camera_T_part=similarity.inverse_pose(pose),
            joints=Joints(
                pivot=similarity.inverse(e.place(joints.pivot)),
                axis=joints.axis @ e.rotation.mT,
                state=torch.where(self._slides(state), state / scale, state),
            ),
            canonical_points=e.shape.points / scale[..., None],
            canonical_part=e.canonical.weights.argmax(-1),
            record=opalign_record(e.rotation, e.translation, joints, canonical),
        )

    def _slides(self, like: Tensor) -> Bool[Tensor, " J"]:
        return torch.tensor([kind == "prismatic" for kind in self.kinds], device=like.device)

    def pictures(self, observation: Observation, stage: str) -> dict[str, PictureData]:
        """Aligned clouds and canonical shapes with their parts and joints."""
        del stage
        points, _ = normalise(observation.points)
        e = self.explain(points, self._colors(observation), None)
        pairs = {
            "canonical": (e.aligned, e.observed, "aligned clouds, parts and joints"),
            "template": (e.shape.points, e.canonical, "canonical shapes, parts and joints"),
        }
        return {
            name: PictureData(panels=_panels(shape, said), caption=caption)
            for name, (shape, said, caption) in pairs.items()
        }


def _disturbed(one: Articulation, noise: Float[Tensor, "B J 3"]) -> Articulation:
    """The same with noise on its axes."""
    axis = F.normalize(one.joints.axis + noise, dim=-1)
    return replace(one, joints=replace(one.joints, axis=axis))


def _normal(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(like.shape, generator=generator, device=generator.device, dtype=like.dtype)


def _panels(points: Float[Tensor, "B N 3"], said: Articulation) -> tuple[Panel, ...]:
    part, joints = said.weights.argmax(-1), said.joints
    return tuple(
        Panel(points=points[i], part=part[i], pivot=joints.pivot[i], axis=joints.axis[i])
        for i in range(len(points))
    )
