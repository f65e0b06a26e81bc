# SPDX-License-Identifier: MIT
"""Methods that can be given labels at test time, such as ICP with true parts: declared by type."""

from __future__ import annotations

from abc import abstractmethod

from scapo.method import AbstractMethod
from scapo.types import Labels, Observation, Prediction, Supervision


class OracleMethod(AbstractMethod):
    """A method that can also answer with true labels of the test split in hand.

    Only `predict --oracle` shows it any, and only `labels.keep(oracle)`. The predictions file then
    says `oracle-...` in its variant, and so does the row of every table.
    """

    oracle: frozenset[Supervision]
    """The labels that it can use."""

    @abstractmethod
    def predict_given(self, observation: Observation, labels: Labels) -> Prediction:
        """As `predict`, with the labels that `oracle` names."""
