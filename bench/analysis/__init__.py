# SPDX-License-Identifier: MIT
"""Why a method scores as it does: ladder, strata, stability, reference answers."""
