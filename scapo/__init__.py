# SPDX-License-Identifier: MIT
"""Self-supervised pose estimation of articulated objects from one point cloud."""
