# SPDX-License-Identifier: MIT
"""What OP-Align's released evaluator asks of a network (CONTRACT 3, `record_*`)."""

from __future__ import annotations

from torch import Tensor

from scapo.objectives import Explanation


def opalign_record(e: Explanation) -> dict[str, Tensor]:
    """What OP-Align's released evaluator asks of a network, under its names.

    Aligned points are R_select^T x - T_select there; S is the aligned shape, I the template.
    """
    encoding = e.encoding
    turned = (encoding.rotation.mT @ encoding.translation[..., None])[..., 0]
    record = {"R_select": encoding.rotation, "T_select": turned}
    for letter, joints in (("S", e.joints), ("I", e.template_joints)):
        record |= {
            f"{letter}_joint": joints.pivot,
            f"{letter}_drct": joints.axis,
            f"{letter}_angl": joints.state,
        }
    return record
