# SPDX-License-Identifier: MIT
"""SCAPO as its paper has it, readable from `method` down to `vector_neurons`."""
