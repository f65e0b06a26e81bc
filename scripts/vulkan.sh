#!/usr/bin/env bash
# SPDX-License-Identifier: MIT
# Give SAPIEN a Vulkan device on a machine that has none: Mesa's CPU driver, from the system's own packages.
#
# Usage: scripts/vulkan.sh [PYTHON]     (PYTHON has sapien installed; default .venv/bin/python)
#
# Always ends 0: without a device the ray-cast renderer is used, and one line says so. The machine's apt sources are
# left as they are: the package lists and the sources used here live in a temporary folder.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

PYTHON="${1:-.venv/bin/python}"
# 22.3 of Debian 12 lacks VK_KHR_external_memory_fd for the CPU device; 24.3 and later have it.
# SAPIEN itself is linked with libX11.
PACKAGES=(libvulkan1 libx11-6 mesa-vulkan-drivers)

say() { printf 'vulkan: %s\n' "$*"; }

fall_back() {
  say "$*; the ray-cast renderer is used instead (\`scapo-data doctor\` says what is missing)"
  exit 0
}

# In a process of its own, because SAPIEN can end the process when a driver misbehaves.
can_render() { timeout 120 "$PYTHON" -W ignore scripts/vulkan_probe.py >"$work/probe.log" 2>&1; }

root() {
  if [ "$(id -u)" -eq 0 ]; then "$@"; else sudo -n "$@"; fi
}

apt_get() {
  root env DEBIAN_FRONTEND=noninteractive NEEDRESTART_SUSPEND=1 apt-get -y -q \
    -o DPkg::Lock::Timeout=300 -o Acquire::Retries=3 -o Dpkg::Use-Pty=0 \
    -o Dir::Etc::SourceList="$work/sources.list" -o Dir::Etc::SourceParts="$work/sources.list.d" \
    -o Dir::State::Lists="$work/lists" -o Dir::Cache="$work/cache" "$@" </dev/null
}

# The machine's own apt sources, plus (for argument 1 = codename) a copy of each entry of the release with the suite
# CODENAME-backports, so that mirror, components and keys are the machine's own.
copy_sources() {
  local codename="$1" file copy
  mkdir -p "$work/sources.list.d" "$work/lists/partial" "$work/cache/archives/partial"
  : >"$work/sources.list"
  for file in /etc/apt/sources.list /etc/apt/sources.list.d/*.list /etc/apt/sources.list.d/*.sources; do
    [ -r "$file" ] || continue
    copy="$work/sources.list.d/$(basename "${file%.*}").${file##*.}"
    cp "$file" "$copy"
    [ -n "$codename" ] || continue
    case "$file" in
      *.list) # deb [options] URI bookworm main
        sed -nE "/^deb[[:space:]]/ s#([[:space:]])$codename([[:space:]])#\1$codename-backports\2#p" "$file" >>"$copy" ;;
      *.sources) # Suites: bookworm bookworm-updates
        sed -i -E "/^Suites:/ s#([[:space:]])$codename([[:space:]]|\$)#\1$codename $codename-backports\2#" "$copy" ;;
    esac
  done
}

main() {
  work="$(mktemp -d)"
  trap 'root rm -rf "$work" 2>/dev/null || rm -rf "$work"' EXIT
  chmod 755 "$work" # apt reads it as user _apt

  if ! "$PYTHON" -c 'import importlib.util as u, sys; sys.exit(u.find_spec("sapien") is None)'; then
    fall_back "sapien is not installed for $PYTHON"
  fi
  if can_render; then
    say "SAPIEN renders on $(tail -n 1 "$work/probe.log")"
    return
  fi
  command -v apt-get >/dev/null || fall_back "SAPIEN finds no Vulkan device, and this is no Debian or Ubuntu"
  if [ "$(id -u)" -ne 0 ] && ! sudo -n true 2>/dev/null; then
    fall_back "SAPIEN finds no Vulkan device, and installing one needs root (as root: make vulkan)"
  fi

  # shellcheck source=/dev/null
  . /etc/os-release
  local backports="" target=()
  if [ "${VERSION_CODENAME:-}" = bookworm ]; then
    backports=bookworm
    target=(-t bookworm-backports)
  fi
  copy_sources "$backports"
  say "installing ${PACKAGES[*]}${backports:+ from $backports-backports}"
  if ! { apt_get update && apt_get install --no-install-recommends "${target[@]}" "${PACKAGES[@]}"; } \
    >"$work/apt.log" 2>&1; then
    grep -E '^(E|Err|W):' "$work/apt.log" | head -n 5 || true
    fall_back "the driver could not be installed"
  fi
  if can_render; then
    say "SAPIEN renders on $(tail -n 1 "$work/probe.log")"
  else
    tail -n 3 "$work/probe.log"
    fall_back "SAPIEN finds no Vulkan device even with ${PACKAGES[*]}"
  fi
}

main
