# SPDX-License-Identifier: MIT
"""URDF models in: `reader.read` makes an `ArticulatedObject` of a file, `library` finds them."""
