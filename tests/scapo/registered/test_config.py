# SPDX-License-Identifier: MIT
"""Options of discovery: refused values."""

from __future__ import annotations

import pytest

from scapo.registered.config import DiscoveryConfig


def test_a_grid_too_coarse_is_refused() -> None:
    with pytest.raises(ValueError, match="rotations: expected at least 200, found 150"):
        DiscoveryConfig(rotations=150)
