# SPDX-License-Identifier: MIT
"""Steps of an optimiser: loss, gradient over all ranks, clipping, schedule; no step into NaN."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from scapo.method import AbstractMethod, Sgd, Stage, StepDecay
from scapo.training.distributed import BAD_LOSS, FINE, Ranks, sum_gradients
from scapo.training.precision import Arithmetic, begin_step

Terms = dict[str, Tensor]
SMALLEST_SCALE = 2.0**-10
"""Of the loss in float16: gradients that still overflow there are no matter of scale."""


class NotFiniteError(ArithmeticError):
    """The loss or its gradient is not finite."""

    def __init__(self, what: str, rank: int, terms: Terms) -> None:
        """What is not (`loss` or `gradient`), on which rank, and this rank's terms."""
        super().__init__(f"{what} on rank {rank}")
        self.what, self.rank, self.terms = what, rank, terms


@dataclass(frozen=True, slots=True, kw_only=True)
class Descent:
    """How steps are made."""

    method: AbstractMethod
    clip: float
    arithmetic: Arithmetic
    device: str
    ranks: Ranks
    scaler: torch.amp.GradScaler

    def step(
        self, optimizer: torch.optim.Optimizer, compute: Callable[[], Terms], share: float
    ) -> Terms | None:
        """Make one step.

        Args:
            optimizer: Of the stage.
            compute: The terms of the loss for this rank's part of the batch.
            share: How large a part that is.

        Returns:
            The terms, their sum `loss` and the norm `gradient`; None for a step that was left out
            because the gradient overflowed float16.

        Raises:
            NotFiniteError: Nothing was changed.
        """
        begin_step(self.arithmetic, self.device)
        self.method.zero_grad()  # what an earlier stage left would count in the norm
        terms, total = self._backward(compute)
        said = sum_gradients(self.method, share, total is not None, self.ranks)
        if BAD_LOSS in said or total is None:
            raise NotFiniteError("loss", said.index(BAD_LOSS), terms)
        self.scaler.unscale_(optimizer)
        norm = nn.utils.clip_grad_norm_(self.method.parameters(), self.clip)
        finite = bool(torch.isfinite(norm))
        if not finite and not self._overflowed():
            rank = next((rank for rank, word in enumerate(said) if word != FINE), 0)
            raise NotFiniteError("gradient", rank, terms)
        self.scaler.step(optimizer)
        self.scaler.update()
        named = {f"loss/{name}": value for name, value in terms.items()}
        return {"loss": total, **named, "gradient": norm} if finite else None

    def _backward(self, compute: Callable[[], Terms]) -> tuple[Terms, Tensor | None]:
        """The terms, and their sum with its gradient taken; None where it is not finite.

        The SVD of what is not finite raises.
        """
        terms: Terms = {}
        try:
            terms = compute()
            total = torch.stack(list(terms.values())).sum()
            if not bool(torch.isfinite(total)):
                return terms, None
            self.scaler.scale(total).backward()
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
            return terms, None
        return terms, total

    def _overflowed(self) -> bool:
        return self.scaler.is_enabled() and self.scaler.get_scale() > SMALLEST_SCALE


def make_optimiser(method: AbstractMethod, stage: Stage) -> torch.optim.Optimizer:
    """The optimiser of a stage, one group of parameters per group of the stage."""
    groups = [
        {
            "params": list(part.parameters()),
            "lr": stage.lr * group.rate,
            "weight_decay": stage.weight_decay
            if group.weight_decay is None
            else group.weight_decay,
        }
        for group in stage.parameters
        for part in [method.get_submodule(group.module) if group.module else method]
    ]
    method.requires_grad_(False)
    kind = stage.optimiser
    if isinstance(kind, Sgd):
        # Not fused: where the first gradient overflows, torch 2.13 leaves its momentum unset.
        return torch.optim.SGD(groups, lr=stage.lr, momentum=kind.momentum, nesterov=kind.nesterov)
    return torch.optim.Adam(groups, lr=stage.lr, betas=kind.betas, fused=True)


def schedule(stage: Stage, optimizer: torch.optim.Optimizer, done: float) -> float:
    """Set learning rates, and which parameters move, for this share of the stage; the rate."""
    rate = learning_rate(stage, done)
    for group, settings in zip(stage.parameters, optimizer.param_groups, strict=True):
        settings["lr"] = rate * group.rate
        for parameter in settings["params"]:
            parameter.requires_grad_(done >= group.begin)
    return rate


def learning_rate(stage: Stage, done: float) -> float:
    """The stage's rate when this share of it is done."""
    kind = stage.schedule
    if isinstance(kind, StepDecay):
        epoch = math.floor(done * stage.epochs + 1e-6)  # a share is not exact
        return max(stage.min_lr, stage.lr * kind.factor ** (epoch // kind.every))
    return stage.min_lr + (stage.lr - stage.min_lr) * (1 + math.cos(math.pi * done)) / 2
