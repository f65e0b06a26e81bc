# SPDX-License-Identifier: MIT
"""Does it open: an object's true joint, pulled in simulation along the path of a predicted one."""
