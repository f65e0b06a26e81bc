#!/usr/bin/env bash
# SPDX-License-Identifier: MIT
# Make .venv with the locked packages, this project (editable) and a Vulkan driver; at once when nothing has changed.
#
# PYTHON=python3.12 scripts/setup.sh         another Python (3.10 to 3.13)
# LOCK=requirements-all.lock scripts/setup.sh  also [gpu-sim] and [cluster]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

LOCK="${LOCK:-requirements.lock}"
VENV=.venv
LOG="$VENV/setup.log"
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1

say() { printf 'setup: %s\n' "$*"; }

fail() {
  printf 'setup: %s\n' "$*" >&2
  exit 1
}

supported() { # supported PYTHON: is it 3.10 to 3.13?
  "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' >/dev/null 2>&1
}

version_of() { "$1" -c 'import platform; print(platform.python_version())'; }

find_python() {
  local candidate
  if [ -n "${PYTHON:-}" ]; then
    command -v "$PYTHON" >/dev/null || fail "PYTHON=$PYTHON: no such program"
    supported "$PYTHON" || fail "PYTHON=$PYTHON is $("$PYTHON" --version 2>&1 | head -n 1), expected Python 3.10 to 3.13"
    printf '%s\n' "$PYTHON"
    return
  fi
  for candidate in python3 python3.11 python3.12 python3.13 python3.10 python; do
    if supported "$candidate"; then
      printf '%s\n' "$candidate"
      return
    fi
  done
  fail "no Python 3.10 to 3.13 found (python3 is $(python3 --version 2>&1 || true)); name one: make setup PYTHON=/path/to/python3.11"
}

fingerprint() { # of all that decides what is in .venv
  { cat "$LOCK" pyproject.toml scripts/setup.sh scripts/vulkan.sh && "$VENV/bin/python" -VV && pwd; } 2>/dev/null | cksum
}

up_to_date() {
  [ -e "$VENV/setup.done" ] && [ "$(cat "$VENV/setup.done")" = "$(fingerprint)" ] || return 1
  [ -z "${PYTHON:-}" ] || [ "$(version_of "$PYTHON")" = "$(version_of "$VENV/bin/python")" ]
}

pip() { "$VENV/bin/python" -m pip "$@" >>"$LOG" 2>&1 </dev/null; }

try_pip() {
  pip install "$@" || {
    grep -v '^WARNING: Location' "$LOG" | tail -n 15 >&2
    fail "pip install $* failed; the whole log is $LOG"
  }
}

new_venv() { "$1" -m venv "$VENV" >/dev/null 2>&1 || { rm -rf "$VENV"; return 1; }; }

venv_package() { "$1" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'; }

# Debian and Ubuntu ship Python without ensurepip.
install_venv_module() {
  local root=(env DEBIAN_FRONTEND=noninteractive apt-get -q -y -o DPkg::Lock::Timeout=300)
  command -v apt-get >/dev/null || return 1
  [ "$(id -u)" -eq 0 ] || { sudo -n true 2>/dev/null && root=(sudo -n "${root[@]}"); } || return 1
  say "installing $(venv_package "$1")"
  { "${root[@]}" update && "${root[@]}" install --no-install-recommends "$(venv_package "$1")"; } </dev/null >/dev/null 2>&1
}

make_venv() {
  local python
  python="$(find_python)"
  if ! supported "$VENV/bin/python" || { [ -n "${PYTHON:-}" ] && [ "$(version_of "$python")" != "$(version_of "$VENV/bin/python")" ]; }; then
    say "$VENV with Python $(version_of "$python")"
    rm -rf "$VENV"
    new_venv "$python" || { install_venv_module "$python" && new_venv "$python"; } ||
      fail "$python cannot make a virtual environment; on Debian and Ubuntu: apt-get install $(venv_package "$python")"
  fi
  : >"$LOG"
}

# torch first, so that what follows finds it there. Without an NVIDIA GPU the CPU build is taken where pip is offered one.
install_torch() {
  local torch
  torch="$(grep -E '^torch==' "$LOCK")"
  if "$VENV/bin/python" -m pip show torch 2>/dev/null | grep -qE "^Version: ${torch#torch==}(\+|\$)"; then
    return
  fi
  say "$torch"
  if [ "$(uname -s)" = Linux ] && ! nvidia-smi >/dev/null 2>&1 && pip install "$torch+cpu"; then
    return
  fi
  try_pip "$torch"
}

main() {
  [ -e "$LOCK" ] || fail "$LOCK: no such lock file"
  if up_to_date; then
    return
  fi
  local begin=$SECONDS
  make_venv
  rm -f "$VENV/setup.done"
  install_torch
  say "the packages of $LOCK"
  try_pip -r "$LOCK"
  try_pip --no-deps --no-build-isolation -e .
  scripts/vulkan.sh "$VENV/bin/python"
  fingerprint >"$VENV/setup.done"
  say "done in $((SECONDS - begin)) s"
}

main
