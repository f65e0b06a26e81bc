# SPDX-License-Identifier: MIT
"""Articulated assets and the labelled point clouds rendered from them (`scapo-data`)."""
