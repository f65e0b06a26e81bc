# SPDX-License-Identifier: MIT
"""Doctests of modules that need an extra are left out where it is not installed."""

from __future__ import annotations

from importlib.util import find_spec

NEEDS = {
    "sim_assets/rendering/sapien.py": "sapien",
    "sim_assets/rendering/maniskill.py": "mani_skill",
    "tests/speed/many.py": "mani_skill",
    "sim_assets/rendering/embree.py": "embreex",
}

collect_ignore = [path for path, package in NEEDS.items() if find_spec(package) is None]
