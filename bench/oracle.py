# SPDX-License-Identifier: MIT
"""Methods that need labels at test time, such as ICP given true parts: declared by their type."""

from __future__ import annotations

from abc import abstractmethod

from scapo.method import AbstractMethod
from scapo.types import Labels, Observation, Prediction, Supervision


class OracleMethod(AbstractMethod):
    """A method that `predict` shows true labels of the test split.

    What it sees is `labels.keep(oracle)`, no more; `variant` must name it, so that the row of
    every table says so, and the predictions file lists it under `budget.oracle`.
    """

    oracle: frozenset[Supervision]

    @abstractmethod
    def predict_given(self, observation: Observation, labels: Labels) -> Prediction:
        """As `predict`, with the labels that `oracle` names."""
