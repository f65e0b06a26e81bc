# SPDX-License-Identifier: MIT
"""Rigid motions, points and cameras: pure functions on tensors, no state."""
