# SPDX-License-Identifier: MIT
"""Pictures of objects: the only room that imports SAPIEN and ManiSkill."""
