# SPDX-License-Identifier: MIT
"""What the training loop and the benchmark ask of a method, ours or a baseline."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from torch import Tensor, nn

from scapo.types import Category, Labels, Observation, Prediction, Supervision


class AbstractMethod(nn.Module):
    """A method of articulated pose estimation for one category.

    `fit.fit` calls `losses` with `labels.keep(method.supervision)`: what the method does not
    declare arrives as None, so a label cannot leak. `predict` sees an Observation alone.
    """

    name: ClassVar[str]
    category: Category
    supervision: frozenset[Supervision]

    @abstractmethod
    def losses(
        self, observation: Observation, labels: Labels, progress: float
    ) -> dict[str, Tensor]:
        """Weighted scalar terms of the loss; their sum is minimised.

        Args:
            observation: A batch, camera frame, metres.
            labels: As allowed by `supervision`.
            progress: Share of the current stage that is done, in [0, 1].
        """

    @abstractmethod
    def predict(self, observation: Observation) -> Prediction:
        """Parts, poses and joints of a batch, in metres and the camera frame."""
