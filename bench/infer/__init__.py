# SPDX-License-Identifier: MIT
"""From somebody's scan to the joints of the object in it.

Inputs (`readers`, `pcd`, `depth`, `cluster`), the answer of the models (`answer`), how far it is to
be trusted (`confidence`), files (`files`), and the same behind a local page (`server`).
"""
