# SPDX-License-Identifier: MIT
"""The digital twin of one observed object, as files.

`record` is what is known of it; it is written as URDF, GLB and meshes, and as a page to look at.
"""
