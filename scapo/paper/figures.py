# SPDX-License-Identifier: MIT
"""What SCAPO shows of its training: canonical clouds, reconstructions, the template."""

from __future__ import annotations

from collections.abc import Iterable

from jaxtyping import Float, Int
from torch import Tensor

from scapo.categories import JointKind
from scapo.paper.heads import JointPairs
from scapo.paper.objectives import Explanation, deform_all
from scapo.paper.skinning import Bones
from scapo.pictures import Panel, PictureData

Pictures = dict[str, PictureData]


def canonical_pictures(e: Explanation, shape: Float[Tensor, "B M 3"]) -> Pictures:
    """Stage 1: are the clouds aligned, does the decoder's shape fit them.

    Args:
        e: Of the networks.
        shape: S_dec.
    """
    aligned = _row(
        "clouds in the canonical frame: the same object parts should lie alike",
        (Panel(points=cloud) for cloud in e.aligned),
    )
    overlaid = _row(
        "the decoder's shape over the observed cloud (grey), canonical frame",
        (
            Panel(points=decoded, beneath=cloud)
            for decoded, cloud in zip(shape, e.aligned, strict=True)
        ),
    )
    return {"canonical": aligned, "reconstruction": overlaid}


def articulated_pictures(e: Explanation, bones: Bones, kinds: tuple[JointKind, ...]) -> Pictures:
    """Stage 2: parts and joints of clouds and template, and the template posed onto each cloud.

    Args:
        e: Of the networks.
        bones: Of the skinning.
        kinds: Of the joints.
    """
    posed = deform_all(e, bones, kinds).y2x
    parts, template_parts = e.weights.argmax(-1), e.template_weights.argmax(-1)
    number = range(len(parts))
    clouds = (_with_joints(e.aligned[i], parts[i], e.joints, i) for i in number)
    shapes = (_with_joints(e.template[i], template_parts[i], e.template_joints, i) for i in number)
    fitted = (Panel(points=posed[i], part=template_parts[i], beneath=e.aligned[i]) for i in number)
    return {
        "canonical": _row("clouds in the canonical frame, parts and joints", clouds),
        "template": _row("the template of each cloud, parts and joints", shapes),
        "reconstruction": _row("the posed template over the observed cloud (grey)", fitted),
    }


def _with_joints(
    points: Float[Tensor, "N 3"], part: Int[Tensor, " N"], joints: JointPairs, sample: int
) -> Panel:
    return Panel(points=points, part=part, pivot=joints.pivot[sample], axis=joints.axis[sample])


def _row(caption: str, panels: Iterable[Panel]) -> PictureData:
    return PictureData(panels=tuple(panels), caption=caption)
