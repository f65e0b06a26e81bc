# SPDX-License-Identifier: MIT
"""The benchmark as a plan of commands, run step by step: `plan`, its `presets`, and `execute`.

A step is a command of `scapo-bench` or `scapo-data` with a log and, once finished, a record.
"""
