# SPDX-License-Identifier: MIT
"""What a depth camera and a mask make of a picture: `depth_camera.disturbed`."""
