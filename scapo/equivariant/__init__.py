# SPDX-License-Identifier: MIT
"""Point convolutions that are equivariant to the icosahedron's 60 rotations, in plain torch.

Features are (B, N, A, C): of each point and anchor, channels last, so that all products are plain
matrix products. `epn` has the 60 rotations as anchors, `e2pn` the 12 vertices; `levels` samples
points and finds neighbours once for all layers; `anchors` is the group.
"""
