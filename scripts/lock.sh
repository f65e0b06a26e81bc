#!/usr/bin/env bash
# SPDX-License-Identifier: MIT
# Resolve pyproject.toml into requirements.lock (what `make setup` installs) and requirements-all.lock (with [gpu-sim],
# [cluster], [kiss-matcher] and [onnx]), one file for all supported Pythons and platforms. Usage: scripts/lock.sh [--upgrade]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

TORCH=2.13.0
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
.venv/bin/python -m venv "$work/tools"
"$work/tools/bin/python" -m pip install -q uv

# The CUDA libraries are dependencies of one build of torch, not ours: pip adds them with that build.
printf '%s\n' triton cuda-bindings cuda-toolkit nvidia-cublas nvidia-cudnn-cu13 nvidia-cusparselt-cu13 nvidia-nccl-cu13 \
  nvidia-nvshmem-cu13 >"$work/excludes.txt"
printf 'torch==%s\n' "$TORCH" >"$work/constraints.txt"

compile() { # compile OUT HEADER ARGUMENTS...
  local out="$1" header="$2"
  shift 2
  "$work/tools/bin/uv" pip compile --quiet --universal --python-version 3.10 --no-header --no-annotate \
    --extra sim --extra bench --extra view --group dev --excludes "$work/excludes.txt" \
    --constraint "$work/constraints.txt" "$@" pyproject.toml --output-file "$work/$out" >/dev/null
  { printf '# SPDX-License-Identifier: MIT\n# Made by `make lock` from pyproject.toml: %s.\n' "$header"; cat "$work/$out"; } >"$work/new"
  mv "$work/new" "$out"
}

if [ "${1:-}" != --upgrade ] && [ -e requirements-all.lock ]; then
  cp requirements-all.lock "$work/requirements-all.lock" # versions already locked are kept where they still fit
fi
compile requirements-all.lock "all extras and the dev group" --extra gpu-sim --extra cluster --extra kiss-matcher --extra onnx
cp requirements-all.lock "$work/all.txt"
compile requirements.lock "[sim], [bench], [view] and the dev group" --constraint "$work/all.txt"
wc -l requirements.lock requirements-all.lock
