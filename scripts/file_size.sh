#!/usr/bin/env bash
# SPDX-License-Identifier: MIT
# Usage: scripts/file_size.sh BYTES FILE...     fails, naming them, when files are larger than BYTES
set -euo pipefail
limit="$1"
shift
large=0
for file in "$@"; do
  size=$(wc -c <"$file")
  if [ "$size" -gt "$limit" ]; then
    printf '%s: %d bytes, expected at most %d\n' "$file" "$size" "$limit" >&2
    large=1
  fi
done
exit "$large"
