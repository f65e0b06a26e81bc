# SPDX-License-Identifier: MIT
"""Pure jobs in worker processes of this machine (`pool`) or of a Ray cluster (`ray`)."""
