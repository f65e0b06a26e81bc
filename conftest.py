# SPDX-License-Identifier: MIT
"""What every test run does: which doctests are left out, and which modules come first."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

NEEDS = {
    "sim_assets/rendering/sapien.py": "sapien",
    "sim_assets/rendering/maniskill.py": "mani_skill",
    "tests/speed/many.py": "mani_skill",
    "sim_assets/rendering/embree.py": "embreex",
}
"""Doctests of modules that need an extra are left out where it is not installed."""

collect_ignore = [path for path, package in NEEDS.items() if find_spec(package) is None]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Modules with slow tests first: one that began last would leave the other cores idle."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
