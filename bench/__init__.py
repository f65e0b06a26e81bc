# SPDX-License-Identifier: MIT
"""The evaluation bench: train, predict, score and tabulate (`scapo-bench`)."""
