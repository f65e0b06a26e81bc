# SPDX-License-Identifier: MIT
"""The numbers that a network starts with: a generator's alone, the same on every device."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def uniform(parameter: Tensor, bound: float, generator: torch.Generator) -> None:
    """Fill with numbers uniform in +-bound, drawn on the CPU so that every device starts alike."""
    draw = torch.rand(parameter.shape, generator=generator, dtype=torch.float32)
    with torch.no_grad():
        parameter.copy_((2 * draw - 1) * bound)


def initialise(module: nn.Module, generator: torch.Generator) -> None:
    """Draw every weight below `module` anew, in the order of `modules()`.

    Linear and convolutional layers as PyTorch does, uniform in +-1/sqrt(inputs); a module of ours
    with a method `reset(generator)` by that. Nothing touches the global random state.
    """
    for child in module.modules():
        if isinstance(child, nn.Linear | nn.Conv2d):
            bound = child.weight[0].numel() ** -0.5
            uniform(child.weight, bound, generator)
            if child.bias is not None:
                uniform(child.bias, bound, generator)
        elif callable(reset := getattr(child, "reset", None)):
            reset(generator)
