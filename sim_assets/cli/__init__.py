# SPDX-License-Identifier: MIT
"""The command line `scapo-data`: verbs that parse, call one function, and print."""
