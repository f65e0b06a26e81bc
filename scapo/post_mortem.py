# SPDX-License-Identifier: MIT
"""The batch on which a training stopped."""

from __future__ import annotations

import math
from pathlib import Path

from jaxtyping import Float, Int
from torch import Tensor

from scapo.checkpoint import array
from scapo.files import write

BAD_BATCH = "bad-batch.safetensors"


def save_batch(
    path: Path,
    stage: str,
    points: Float[Tensor, "B N 3"],
    index: Int[Tensor, " B"],
    terms: dict[str, Tensor],
) -> str:
    """Write clouds, their indices in the split and the terms of the loss; what is wrong."""
    values = {name: str(float(value.detach())) for name, value in terms.items()}
    header = {"format": "scapo-bad-batch/1", "stage": stage, "terms": values}
    write(path, {"points": array(points), "index": array(index)}, header)
    bad = [name for name, value in values.items() if not math.isfinite(float(value))]
    if bad:
        return ", ".join(bad)
    return "finite terms with a bad gradient" if values else "a matrix without decomposition"
