# SPDX-License-Identifier: MIT
"""Splits of clouds on disk, planned, made by workers, resumable: `generate.generate`."""
