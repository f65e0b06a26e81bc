# SPDX-License-Identifier: MIT
"""EAP: `method` is read first, then `whole` (stage 0) and `parts` (stage 1)."""
