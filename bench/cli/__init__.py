# SPDX-License-Identifier: MIT
"""The command line `scapo-bench`: verbs that parse, call one function, and print."""
