# SPDX-License-Identifier: MIT
"""EAP: parts by slots on rotation-equivariant features, poses by reconstruction under anchors.

Liu et al., "Self-Supervised Category-Level Articulated Object Pose Estimation with Part-Level
SE(3) Equivariance", ICLR 2023; docs/methods.md says what differs. No label is used.

Frames: `camera` in metres; `input`, the cloud centred and scaled to mean radius 0.25; `aligned`,
turned by stage 0; `canonical`, where the shapes of the slots stand.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from bench.baselines.eap.layers import EncoderConfig
from bench.baselines.eap.parts import PartConfig, PartStage, Passed, Usual
from bench.baselines.eap.whole import Whole, WholeConfig, WholeStage
from scapo.categories import Category
from scapo.first_weights import initialise
from scapo.geometry.points import gather, nearest, normalise
from scapo.geometry.rigid import rigid
from scapo.method import (
    AbstractMethod,
    HalfCosine,
    Mode,
    ParameterGroup,
    Stage,
    Step,
    StepDecay,
    changes,
    evenly,
)
from scapo.paper.heads import thin
from scapo.pictures import Panel, PictureData
from scapo.ranges import Share
from scapo.types import Joints, Labels, Observation, Prediction

WHOLE, PARTS, USUAL = "whole", "parts", "usual"
"""The stages: of the object's rotation, of the parts, and the choice of anchor and base."""
CALIBRATED_ON = 500
"""Training clouds whose anchors and bases are counted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LossConfig:
    """Weights of stage 1's terms; stage 0 has one."""

    whole: float = 1.0
    """Weight of the distance between the cloud and its whole reconstruction."""
    slots: float = 0.5
    """Weight of the distances of the slots' shapes."""
    pivot: float = 1.0
    """Weight of the pivots' distance to both parts."""
    shifts: int = 10
    """How many shifts of the pivot along the axis a step draws."""
    joint_length: float = 0.3
    """Largest shift, normalised units."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EapConfig:
    """EAP, without labels; the defaults are the published values."""

    preset: Literal["paper", "cpu"] = "paper"
    """Where the other defaults come from."""
    points: int = 512
    """Points that the networks look at, evenly taken from the cloud's order."""
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """Sizes of both encoders."""
    whole: WholeConfig = field(default_factory=WholeConfig)
    """Sizes of stage 0."""
    parts: PartConfig = field(default_factory=PartConfig)
    """Sizes of stage 1."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Weights of stage 1's terms."""
    mode: Literal["usual", "each"] = "usual"
    """Anchor of the parts at test time: the one that most training clouds choose (published: one
    picked by hand for each category), or each cloud's own."""
    epochs: tuple[int, int] = (32, 32)
    """Epochs of both stages: with 5,000 clouds the learning rate has then reached its least."""
    lr: float = 1e-4
    """Learning rate at the start."""
    min_lr: float = 1e-7
    """Least learning rate."""
    decay: Share = 0.64
    """Factor of the learning rate every `decay_every` epochs: published, 0.7 every 1,000 steps of
    8 clouds, is this where there are 5,000 of them."""
    decay_every: int | None = 2
    """Epochs; None: half a cosine in each stage down to `min_lr` instead, however few epochs it
    has."""
    weight_decay: float = 1e-8
    """Added to the gradient, times the weights."""
    batch: int = 8
    """Clouds a step."""


def cpu_config() -> EapConfig:
    """The lean preset: the same structure with fewer points and channels, one pass."""
    return EapConfig(
        preset="cpu",
        points=64,
        encoder=EncoderConfig(channels=(8, 16, 16), radii=(0.19, 0.26, 0.38), neighbours=8),
        whole=WholeConfig(width=48, points=96, chosen_by=64),
        parts=PartConfig(width=48, points=40, passes=1),
        loss=LossConfig(pivot=0.1),  # 1 outweighs both reconstructions at the start
        epochs=(4, 2),
        lr=1e-3,
        min_lr=1e-5,
        decay_every=None,
    )


UNNAMED = frozenset({"preset", "lr", "min_lr", "weight_decay", "decay", "decay_every"})
"""Options that make no other variant."""


class Eap(AbstractMethod):
    """The method, for one category."""

    name: ClassVar[str] = "eap"
    networks = ("whole_stage.encoder", "part_stage.encoder", "part_stage.grouping")
    least_batch = 2  # norms of the layers on codes, one a cloud
    usual_base: Tensor
    usual_anchor: Tensor

    def __init__(self, config: EapConfig, category: Category, generator: torch.Generator) -> None:
        """Build the networks and draw their weights.

        Args:
            config: Sizes, losses, stages.
            category: Fixes the number of slots and the kind of the joints, nothing else.
            generator: On the CPU; the only source of the initial weights.
        """
        super().__init__()
        self.config = config
        self.category = category
        self.supervision = frozenset()
        self.kind = category.joints[0].kind
        with torch.random.fork_rng(devices=[]):  # layers draw before `initialise` draws again
            self.whole_stage = WholeStage(config.whole, config.encoder)
            slots = len(category.parts)
            self.part_stage = PartStage(config.parts, config.encoder, slots, self.kind)
        initialise(self, generator)
        self.register_buffer("usual_base", torch.tensor(-1))
        self.register_buffer("usual_anchor", torch.tensor(-1))

    @property
    def variant(self) -> str:
        """The preset and other options."""
        config = self.config
        preset = EapConfig() if config.preset == "paper" else cpu_config()
        words = [] if config.preset == "paper" else [config.preset]
        return "-".join([*words, *changes(config, preset, leave=UNNAMED)])

    def stages(self) -> tuple[Stage, ...]:
        """The whole object, then the parts with the whole frozen, then a count without steps."""
        config = self.config
        every = config.decay_every
        modules = ("whole_stage", "part_stage", "part_stage")
        return tuple(
            Stage(
                name=name,
                epochs=epochs,
                lr=config.lr,
                min_lr=config.min_lr,
                weight_decay=config.weight_decay,
                batch=config.batch,
                parameters=(ParameterGroup(module=module),),
                schedule=HalfCosine()
                if every is None
                else StepDecay(every=every, factor=config.decay),
            )
            for name, module, epochs in zip(
                (WHOLE, PARTS, USUAL), modules, (*config.epochs, 0), strict=True
            )
        )

    @torch.no_grad()
    def start(
        self, stage: str, observation: Observation, labels: Labels, generator: torch.Generator
    ) -> None:
        """Before the last stage: count which slot is the base, and which anchor fits, most often.

        No label is used, of training clouds or others.
        """
        del labels, generator
        if stage != USUAL:
            return
        self.eval()
        chosen = evenly(observation.points.shape[0], CALIBRATED_ON)
        found = [
            self.explain(normalise(observation.points[some])[0], Usual())[1][-1].one
            for some in chosen.split(16)
        ]
        base = torch.cat([one.chosen.base for one in found]).mode().values
        self.usual_base = base
        # Anchors of clouds with another base are of another canonical frame.
        anchor = [one.anchor[one.chosen.base == base] for one in found]
        self.usual_anchor = torch.cat(anchor).mode().values

    def explain(self, points: Float[Tensor, "B N 3"], usual: Usual) -> tuple[Whole, list[Passed]]:
        """Both stages on clouds in the input frame, the first frozen."""
        self.whole_stage.eval()
        with torch.no_grad():
            whole = self.whole_stage(thin(points, self.config.points), points)
        return whole, self.part_stage.passes(thin(whole.aligned, self.config.points), usual)

    def losses(self, observation: Observation, labels: Labels, step: Step) -> dict[str, Tensor]:
        """The terms of the stage, times their weights, the mean over passes."""
        del labels
        points, _ = normalise(observation.points)
        if step.stage == WHOLE:
            few = thin(points, self.config.points)
            return {"whole": self.whole_stage(few, few).loss()}
        config = self.config.loss
        drawn = torch.rand(config.shifts, generator=step.generator, device=points.device)
        _, passes = self.explain(points, Usual())
        terms = [passed.one.terms(config.joint_length * drawn) for passed in passes]
        return {
            name: getattr(config, name) * torch.stack([one[name] for one in terms]).mean()
            for name in terms[0]
        }

    def _usual(self) -> Usual:
        """What the training has settled on."""
        base, anchor = int(self.usual_base), int(self.usual_anchor)
        if base < 0:
            return Usual()
        return Usual(base=base, anchor=anchor if self.config.mode == "usual" else None)

    @torch.no_grad()
    def predict(self, observation: Observation, mode: Mode = "fast") -> Prediction:
        """Slots with the base first, each other point with the slot of the nearest looked at."""
        del mode
        points, similarity = normalise(observation.points)
        whole, passes = self.explain(points, self._usual())
        last = passes[-1]
        order, shapes = last.one.chosen.order(), last.one.chosen.shapes
        place = rigid(whole.rotation, torch.zeros_like(whole.rotation[:, 0]))[:, None]
        poses = gather((place @ last.poses()).flatten(2), order).unflatten(2, (4, 4))
        pivot, axis, state = last.joints()
        scale = similarity.scale[:, None]
        few = thin(whole.aligned, self.config.points)
        return Prediction(
            part_weight=spread(whole.aligned, few, last.one.weights, order),
            camera_T_part=similarity.inverse_pose(poses),
            joints=Joints(
                pivot=similarity.inverse(pivot @ whole.rotation.mT),
                axis=axis @ whole.rotation.mT,
                state=state / scale if self.kind == "prismatic" else state,
            ),
            canonical_points=shapes.flatten(1, 2) / scale[..., None],
            canonical_part=order.argsort(1)[..., None].expand(shapes.shape[:3]).flatten(1),
        )

    def pictures(self, observation: Observation, stage: str) -> dict[str, PictureData]:
        """Aligned clouds over the reconstruction; of the parts, their slots and shapes."""
        points, _ = normalise(observation.points)
        whole, passes = self.explain(points, self._usual())
        if stage == WHOLE:
            pairs = zip(whole.shape, whole.aligned, strict=True)
            panels = tuple(Panel(points=shape, beneath=cloud) for shape, cloud in pairs)
            caption = "the reconstruction over the aligned cloud (grey)"
            return {"reconstruction": PictureData(panels=panels, caption=caption)}
        one = passes[0].one
        pairs = zip(one.points, one.weights.argmax(-1), strict=True)
        panels = tuple(Panel(points=cloud, part=slot) for cloud, slot in pairs)
        return {"canonical": PictureData(panels=panels, caption="aligned clouds and their slots")}


def spread(
    points: Float[Tensor, "B N 3"],
    few: Float[Tensor, "B K 3"],
    weights: Float[Tensor, "B K S"],
    order: Tensor,
) -> Float[Tensor, "B N S"]:
    """Weights of all points from the nearest of those looked at, slots in the order."""
    return gather(weights, nearest(points, few)).gather(
        2, order[:, None].expand(-1, points.shape[1], -1)
    )
