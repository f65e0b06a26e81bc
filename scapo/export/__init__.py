# SPDX-License-Identifier: MIT
"""Articulated objects written for other programs: `urdf` folders and single `glb` files."""
