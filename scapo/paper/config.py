# SPDX-License-Identifier: MIT
"""What can be chosen of SCAPO, and the presets: the paper's values, its letter, and lean ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from scapo.paper.autoencoder import DecoderConfig, EncoderConfig
from scapo.paper.heads import HeadConfig, JointConfig
from scapo.paper.objectives import LossConfig
from scapo.paper.part_search import SearchConfig
from scapo.ranges import MOST, Positive, Range


@dataclass(frozen=True, slots=True, kw_only=True)
class ScapoConfig:
    """SCAPO, the paper's method, without labels; the defaults are its values (Sec. 4)."""

    preset: Literal["paper", "literal", "cpu", "complete", "warm"] = "paper"
    """Where the other defaults come from."""
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """Sizes of the encoder."""
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    """Sizes of the decoder."""
    joint: JointConfig = field(default_factory=JointConfig)
    """Sizes of the joint network."""
    heads: HeadConfig = field(default_factory=HeadConfig)
    """Sizes of the keypoint and residual networks."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Weights and forms of the loss terms."""
    gamma: Positive = 0.01
    """Start of the skinning temperature, for a mean radius of 0.25."""
    template_start: Literal["medoid", "random"] = "medoid"
    """Y_base and K: the decoded medoid of the training codes, or random numbers."""
    part_start: Literal["means", "search", "run"] = "means"
    """Bones, joints and networks of stage 2 begin at the P-means of the template, at what a search
    of parts explains the clouds best by, or at what a run of `registered` says of them; that run's
    frames then take the place of stage 1's losses (neither is in the paper)."""
    search: SearchConfig = field(default_factory=SearchConfig)
    """Used with `part_start` search; `spread` and `teaching` with run too."""
    start: str | None = None
    """A trained `registered` of the same category, for `part_start` run: its run folder, its
    checkpoint or a released model's name."""
    told_of: Literal["views", "surfaces"] = "views"
    """What the clouds show: one side of an object, as that run's clouds do, or the whole of it,
    which it is then shown from many sides (0.25 s each)."""
    told: int = 2000
    """Training clouds that this run is asked for, about 0.06 s each on one core."""
    bones_turn: bool = False
    """V of a bone turns with its part (BANMo); otherwise it is the same in every state."""
    labels_of: Literal["skinning", "template", "told"] = "skinning"
    """Whose weights a prediction gives: w of the bones on S_obj; those of the nearest point of the
    posed template, which ends at the hinge where two Gaussians do not; or the parts of which the
    nearest dozen were where stage 2 began, since no Gaussian is a door in front of its body."""
    encoder_in_stage_2: Literal["joint", "frozen", "end-to-end"] = "joint"
    """joint: frozen for the first half, then a tenth of the rate; end-to-end: all of it."""
    supervision: tuple[Literal["segmentation", "joint", "instance"], ...] = ()
    """Labels that training may see: segmentation and joint in Table 2; instance where the run in
    `start` was told which clouds show the same object."""
    epochs: Annotated[tuple[int, ...], Range(0, MOST, many=(1, 2))] = (200, 200)
    """Epochs of each stage; one number for both. A stage of none is left out."""
    lr: tuple[float, float] = (1e-3, 1e-4)
    """Learning rate at the start of each stage."""
    min_lr: float = 1e-6
    """Learning rate at the end of a stage."""
    weight_decay: float = 1e-8
    """Added to the gradient, times the weights."""
    batch: int = 16
    """Clouds a step."""
    points: int | None = None
    """Points of a cloud that the encoder sees and a step of training uses; None = all."""


def cpu_config() -> ScapoConfig:
    """The lean preset: under 1.5 M parameters, a few edges at a few centres, one-sided terms."""
    return ScapoConfig(
        preset="cpu",
        encoder=EncoderConfig(
            neighbours=12, centres=64, width=16, branch=(32, 96, 64, 32), features=48
        ),
        decoder=DecoderConfig(patches=4, points=512, widths=(128, 64, 64)),
        joint=JointConfig(width=48, blocks=3, head=(128, 64), points=256),
        heads=HeadConfig(keypoint=(256, 128, 128), residual=(64, 64)),
        loss=LossConfig(
            recon_form="partial",
            disturbances=("noise", "crop", "resample"),
            disturbances_per_step=1,
            state_gauge=10.0,
            part_mass=10.0,
            boundary_temperature=0.05,
        ),
        epochs=(16, 16),
        lr=(2e-3, 1e-3),
        batch=32,
    )


def literal_config() -> ScapoConfig:
    """What is printed and nothing else, where print says anything (docs/method.md).

    No second Chamfer distance, all of stage 2 end to end at one rate, both states of a joint free,
    the squared norm of the whole residual, gradients through entropies and points, no agreement
    term for two joints, and a template that starts at random.
    """
    return ScapoConfig(
        preset="literal",
        joint=JointConfig(base_fixed=False),
        loss=LossConfig(
            rec_aligned=0.0,
            base_gap=0.0,
            variance_form="whole",
            proximity_detach=False,
            boundary_detach=False,
        ),
        template_start="random",
        encoder_in_stage_2="end-to-end",
    )


def complete_config() -> ScapoConfig:
    """Lean, for whole surfaces: parts are searched for, and reconstruction outweighs priors."""
    lean = cpu_config()
    return replace(
        lean,
        preset="complete",
        points=512,
        encoder=replace(lean.encoder, centres=48, neighbours=40, branch=(32, 64, 48, 32)),
        decoder=replace(lean.decoder, points=256),
        joint=replace(lean.joint, width=32, points=192, base_fixed=False, revolute_range=4.0),
        loss=replace(
            lean.loss,
            recon_form="squared",
            recon=300.0,
            shape_var=1.0,
            seg=0.1,
            joint_boundary=0.1,
            state_gauge=1.0,
        ),
        part_start="search",
        bones_turn=True,
        labels_of="template",
        epochs=(5, 5),
    )


def warm_config() -> ScapoConfig:
    """Lean, for partial views: the networks begin at what a run of `registered` says.

    Stage 2 is one that keeps what it is given: foreign points are far in a squared distance, the
    line where parts meet is a laptop's hinge and no pivot, and an encoder that learns goes along.
    """
    lean = complete_config()
    return replace(
        lean,
        preset="warm",
        decoder=replace(lean.decoder, points=512),
        loss=replace(lean.loss, recon_form="robust", dir_align=0.0),
        part_start="run",
        labels_of="told",
        search=replace(lean.search, teaching=800),
        encoder_in_stage_2="frozen",
        epochs=(30, 2),
        lr=(2e-3, 3e-4),
    )


PRESETS: dict[str, Callable[[], ScapoConfig]] = {
    "paper": ScapoConfig,
    "literal": literal_config,
    "cpu": cpu_config,
    "complete": complete_config,
    "warm": warm_config,
}
