# SPDX-License-Identifier: MIT
"""The paper's tables from scores per sample: `write.write`."""
