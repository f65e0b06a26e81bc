# SPDX-License-Identifier: MIT
"""Predictions and truth to errors per sample: `evaluate.evaluate`."""
