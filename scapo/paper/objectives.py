# SPDX-License-Identifier: MIT
"""Which terms each stage sums, with the weights of Sec. 4; the terms themselves are in `losses`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.rigid import apply, invert, random_rotations
from scapo.paper import losses
from scapo.paper.augment import DISTURBANCES, Disturbance, disturb, one_side
from scapo.paper.autoencoder import Decoder, Encoder, Encoding
from scapo.paper.heads import JointPairs
from scapo.paper.skinning import (
    Bones,
    base_gap,
    cross_maps,
    deform,
    incident_maps,
    part_maps,
    to_canonical,
)
from scapo.ranges import Neighbours, Positive

AblatedTerm = Literal["shape_var", "dir_align", "joint_prox", "joint_boundary"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LossConfig:
    """Weights and readings of the loss; defaults are the paper's (Sec. 4) and docs/method.md's."""

    rec: float = 1.0
    rec_aligned: float = 0.1
    """VNT's second Chamfer distance, between the aligned cloud and S_dec."""
    ortho: float = 0.1
    aug: float = 0.1
    can: float = 0.1
    views: float = 0.0
    """As L_can_consist, of S_dec as two cameras see it, a side each. Not in the paper."""
    cycle: float = 10.0
    """Of the cloud and, with the same weight, of the template."""
    recon: float = 10.0
    """L_recon and, with the same weight, L_recon^Y."""
    kp_seg: float = 1.0
    seg: float = 1.0
    shape_var: float = 10.0
    dir_align: float = 0.1
    joint_prox: float = 1.0
    joint_boundary: float = 3.0
    base_gap: float = 10.0
    """Two joints must agree on where the base goes (OP-Align); without effect for one joint."""
    state_gauge: float = 0.0
    """OP-Align: 10. Not in the paper."""
    part_mass: float = 0.0
    """OP-Align: 10. Not in the paper."""
    labelled_segmentation: float = 1.0
    """Used with `supervision` segmentation only."""
    labelled_joints: float = 1.0
    """Used with `supervision` joint only."""
    without: tuple[AblatedTerm, ...] = ()
    """Terms left out: the rows of the paper's Table 3."""

    rec_form: losses.ReconForm = "squared"
    recon_form: losses.ReconForm = "squared"
    """`partial` for clouds seen from one side."""
    disturbances: tuple[Disturbance, ...] = DISTURBANCES
    disturbances_per_step: int = 0
    """How many of them, drawn at random, a step of stage 1 uses; 0 = all."""
    shift: float = 0.1
    """Half the range of the random translation of the input."""
    variance_form: losses.VarianceForm = "per-point"
    variance_scale: float = 60.0
    proximity_scale: float = 30.0
    proximity_neighbours: Neighbours = 1
    proximity_detach: bool = True
    """The points of L_joint-prox are constants."""
    support: Positive = 20.0
    """tau of L_kp-seg, in points."""
    support_mean: losses.KeypointMean = "parts"
    boundary_temperature: Positive = 1.0
    boundary_detach: bool = True

    def weight(self, term: str) -> float:
        """The factor of a term, 0 for one that is left out."""
        return 0.0 if term in self.without else float(getattr(self, term.removesuffix("_template")))


def weigh(
    terms: Mapping[str, Callable[[], Float[Tensor, ""]]], config: LossConfig
) -> dict[str, Float[Tensor, ""]]:
    """Evaluate the terms whose weight is not 0, times that weight."""
    return {
        name: config.weight(name) * term() for name, term in terms.items() if config.weight(name)
    }


def canonicalisation(
    encoder: Encoder,
    decoder: Decoder,
    points: Float[Tensor, "B N 3"],
    config: LossConfig,
    generator: torch.Generator,
) -> dict[str, Float[Tensor, ""]]:
    """Stage 1 (Sec. 3.1): L = L_rec + l1 L_ortho + l2 L_aug_consist + l3 L_can_consist."""
    encoding = encoder(points)
    shape, _ = decoder(encoding.code)  # S_dec (B, N, 3)
    encoding = encoding.nearest(points, shape, encoder.config)

    def rec() -> Tensor:
        # In the aligned frame: the distance is the same, and so is VNT's second term.
        return losses.reconstruction(encoding.align(points), shape, config.rec_form)

    def aug() -> Tensor:
        chosen = _draw(config, generator)
        others = [encoder(disturb(points, kind, generator)) for kind in chosen]
        share = len(config.disturbances) / len(chosen)
        same = [other.by(encoding.chosen, encoder.config) for other in others]
        return share * sum_of(_agree(other, encoding) for other in same)

    def can() -> Tensor:
        return _recovered(encoder, shape.detach(), generator)

    def views() -> Tensor:
        sides = [one_side(shape.detach(), points.shape[1], generator) for _ in range(2)]
        return sum_of(_recovered(encoder, side, generator) for side in sides) / 2

    reconstructed = rec()
    terms: dict[str, Callable[[], Tensor]] = {
        "rec": lambda: reconstructed,
        "rec_aligned": lambda: reconstructed,
        "ortho": lambda: losses.orthonormality(encoding.frame),
        "aug": aug,
        "can": can,
        "views": views,
    }
    return weigh(terms, config)


def _recovered(
    encoder: Encoder, shape: Float[Tensor, "B N 3"], generator: torch.Generator
) -> Tensor:
    """How far the pose is missed of points in the aligned frame that are turned at random."""
    turn = random_rotations(shape.shape[0], generator, dtype=shape.dtype)
    again = encoder(shape @ turn.mT).facing(turn, encoder.config)
    zero = torch.zeros_like(again.translation)
    return losses.pose_agreement(again.rotation, again.translation, turn, zero)


def _agree(other: Encoding, encoding: Encoding) -> Tensor:
    return losses.pose_agreement(
        other.rotation, other.translation, encoding.rotation, encoding.translation
    )


def _draw(config: LossConfig, generator: torch.Generator) -> list[Disturbance]:
    """The disturbances of this step."""
    kinds = config.disturbances
    count = config.disturbances_per_step or len(kinds)
    if count >= len(kinds):
        return list(kinds)
    order = torch.randperm(len(kinds), generator=generator, device=generator.device)
    return [kinds[i] for i in order[:count].tolist()]


@dataclass(frozen=True, slots=True, kw_only=True)
class Explanation:
    """All that the networks say of a batch of clouds, in normalised units."""

    encoding: Encoding
    aligned: Float[Tensor, "B N 3"]
    """S_obj."""
    template: Float[Tensor, "B M 3"]
    """Y_X."""
    residual: Float[Tensor, "B M 3"]
    """Delta S_X."""
    keypoints: Float[Tensor, "B P 3"]
    """K_x, aligned frame."""
    template_keypoints: Float[Tensor, "B P 3"]
    """K_Y, the same for all of the batch."""
    joints: JointPairs
    """Aligned frame."""
    template_joints: JointPairs
    """Template frame."""
    weights: Float[Tensor, "B N P"]
    template_weights: Float[Tensor, "B M P"]
    bone_turn: Float[Tensor, "B P 3 3"] | None = None
    """How the cloud's bones are turned against the template's; None where they are not."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Deformations:
    """Both shapes carried through the spaces of Sec. 3.2."""

    canonical: Float[Tensor, "B N 3"]
    """S*."""
    canonical_keypoints: Float[Tensor, "B P 3"]
    """K*: the bone maps applied to K_x."""
    canonical_weights: Float[Tensor, "B N P"]
    """w*, evaluated on S* anew; the cycle itself reuses w."""
    returned: Float[Tensor, "B N 3"]
    """S^_obj."""
    template_returned: Float[Tensor, "B M 3"]
    """Y^_X."""
    x2y: Float[Tensor, "B N 3"]
    y2x: Float[Tensor, "B M 3"]
    gap: Float[Tensor, ""]
    """How far the maps of the base through its joints disagree."""


def deform_all(e: Explanation, bones: Bones, kinds: tuple[JointKind, ...]) -> Deformations:
    """Apply D^{o->c}, D^{c->o}, D^{X->Y} and D^{Y->X}."""
    own = part_maps(incident_maps(e.joints, kinds))
    canonical = to_canonical(own, e.aligned, e.weights)
    keypoints = apply(invert(own), e.keypoints[:, :, None])[:, :, 0]
    turn = None if e.bone_turn is None else own[..., :3, :3].mT @ e.bone_turn
    template_own = part_maps(incident_maps(e.template_joints, kinds))
    template_canonical = to_canonical(template_own, e.template, e.template_weights)
    to_template = cross_maps(e.joints, e.template_joints, kinds)
    to_aligned = cross_maps(e.template_joints, e.joints, kinds)
    return Deformations(
        canonical=canonical,
        canonical_keypoints=keypoints,
        canonical_weights=bones.weights(canonical, keypoints, turn),
        returned=deform(own, canonical, e.weights),
        template_returned=deform(template_own, template_canonical, e.template_weights),
        x2y=deform(part_maps(to_template), e.aligned, e.weights),
        y2x=deform(part_maps(to_aligned), e.template, e.template_weights),
        gap=base_gap(to_template, e.aligned, e.weights)
        + base_gap(to_aligned, e.template, e.template_weights),
    )


def articulation(
    e: Explanation, bones: Bones, kinds: tuple[JointKind, ...], config: LossConfig
) -> dict[str, Float[Tensor, ""]]:
    """Stage 2 (Sec. 3.2, 3.3): the terms that need no label."""
    d = deform_all(e, bones, kinds)
    terms: dict[str, Callable[[], Tensor]] = {
        "cycle": lambda: losses.cycle(e.encoding.place(d.returned), e.encoding.place(e.aligned)),
        "cycle_template": lambda: losses.cycle(d.template_returned, e.template),
        "recon": lambda: losses.reconstruction(d.x2y, e.template, config.recon_form),
        "recon_template": lambda: losses.reconstruction(e.aligned, d.y2x, config.recon_form),
        "shape_var": lambda: losses.shape_variance(
            e.residual, config.variance_scale, config.variance_form
        ),
        "base_gap": lambda: d.gap,
        "state_gauge": lambda: losses.state_gauge(e.template_joints.state, e.template_joints.axis),
        "part_mass": lambda: losses.part_mass(e.weights) + losses.part_mass(e.template_weights),
        **keypoint_terms(e, d, config),
        **joint_terms(e, d, kinds, config),
    }
    return weigh(terms, config)


def keypoint_terms(
    e: Explanation, d: Deformations, config: LossConfig
) -> dict[str, Callable[[], Float[Tensor, ""]]]:
    """The two regularisers of the segmentation (Sec. 3.3)."""
    triples = (
        (e.keypoints, e.aligned, e.weights),
        (e.template_keypoints, e.template, e.template_weights),
        (d.canonical_keypoints, d.canonical, d.canonical_weights),
    )

    def seg() -> Tensor:
        nearest = losses.nearest_keypoint(e.aligned, e.keypoints)
        return losses.segmentation(e.weights, nearest) + losses.segmentation(
            d.canonical_weights, nearest
        )

    return {
        "kp_seg": lambda: sum_of(
            losses.keypoint_segmentation(*triple, config.support, config.support_mean)
            for triple in triples
        ),
        "seg": seg,
    }


def joint_terms(
    e: Explanation, d: Deformations, kinds: tuple[JointKind, ...], config: LossConfig
) -> dict[str, Callable[[], Float[Tensor, ""]]]:
    """The three regularisers of the joints (Sec. 3.3), on S* (or S_obj) and on Y_X."""
    x, y = e.joints, e.template_joints
    terms: dict[str, Callable[[], Tensor]] = {
        "joint_prox": lambda: sum_of(
            losses.joint_proximity(
                pivot,
                points,
                config.proximity_scale,
                config.proximity_neighbours,
                detach=config.proximity_detach,
            )
            for pivot, points in ((x.pivot, d.canonical), (y.pivot, e.template))
        ),
        "joint_boundary": lambda: sum_of(
            losses.joint_boundary(
                pivot, points, weights, config.boundary_temperature, detach=config.boundary_detach
            )
            for pivot, points, weights in (
                (x.pivot, e.aligned, e.weights),
                (y.pivot, e.template, e.template_weights),
            )
        ),
    }
    if all(kind == "revolute" for kind in kinds):  # a slide has no line of boundary points
        terms["dir_align"] = lambda: (
            losses.joint_direction(x.axis, d.canonical, d.canonical_weights)
            + losses.joint_direction(y.axis, e.template, e.template_weights)
        )
    return terms


def sum_of(terms: Iterable[Tensor]) -> Tensor:
    """Their sum as a tensor."""
    return torch.stack(list(terms)).sum()
