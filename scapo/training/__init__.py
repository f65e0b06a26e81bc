# SPDX-License-Identifier: MIT
"""The training loop of any method: `fit.fit` alone is what others call."""
