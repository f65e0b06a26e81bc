# SPDX-License-Identifier: MIT
"""OP-Align: `method` is read first, then `heads` and `backbone`; `losses` has every term."""
