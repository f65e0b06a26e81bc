# SPDX-License-Identifier: MIT
"""The type checker of the test run: each call of our packages, shapes included."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

# An int is a float, as for the static checker.
checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
