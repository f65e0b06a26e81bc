# SPDX-License-Identifier: MIT
"""Runs of a method: `train`, `predict` and the page of a run."""
