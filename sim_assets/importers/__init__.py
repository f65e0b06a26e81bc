# SPDX-License-Identifier: MIT
"""External data sets into our layouts, a file each: `sets.import_set`."""
