# SPDX-License-Identifier: MIT
"""What works on this machine: renderers, drivers, packages, and how to get what is missing.

Each renderer is tried in a process of its own (`probe`), since a broken driver can end the process;
all are tried side by side.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from rich.console import Group
from rich.table import Table
from rich.text import Text

PROBE_SECONDS = 120.0
RENDERERS = ("sapien", "raycast", "maniskill")

PACKAGES: dict[str, tuple[str, ...]] = {
    "core": ("torch", "numpy", "scipy", "roma", "safetensors", "jaxtyping", "rich", "tyro"),
    "sim": ("sapien", "embreex", "trimesh", "yourdfpy", "lxml", "pillow"),
    "gpu-sim": ("mani-skill",),
    "bench": ("pandas", "small-gicp", "matplotlib", "tensorboard"),
    "view": ("viser",),
    "cluster": ("ray",),
}
"""Packages by the extra that brings them."""

ICD_FOLDERS = ("/etc/vulkan/icd.d", "/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
MESA_PACKAGE = "mesa-vulkan-drivers"
SCRIPT = (
    Path(__file__).resolve().parent.parent.parent / "scripts" / "vulkan.sh"
)  # in a checkout only


@dataclass(frozen=True, slots=True, kw_only=True)
class Renderer:
    """One way to make pictures, as found here."""

    name: str
    works: bool
    detail: str
    """The device it drew on, or why it did not."""
    remedy: str
    """The command that supplies what is missing; empty where nothing is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorReport:
    """What was found on this machine."""

    system: str
    """Operating system, processor, Python."""
    renderers: tuple[Renderer, ...]
    """In the order in which `--backend auto` tries them."""
    packages: tuple[tuple[str, str, str | None], ...]
    """(extra, package, version or None where it is not installed)."""
    drivers: tuple[tuple[str, str], ...]
    """(what, version or path): Vulkan loader and drivers, Mesa, NVIDIA, CUDA."""

    @property
    def backend(self) -> str | None:
        """What `--backend auto` uses here; None where nothing renders."""
        return next((r.name for r in self.renderers if r.works and r.name != "maniskill"), None)


def report(on_progress: Callable[[str], None] = lambda line: None) -> DoctorReport:
    """Look at this machine; takes some seconds, because every renderer draws a picture.

    Args:
        on_progress: Called with a line for each thing that is tried, and with what came of it.
    """
    with ThreadPoolExecutor() as threads:
        drivers = threads.submit(_drivers)
        tried = {threads.submit(_try, name): name for name in RENDERERS}
        for name in RENDERERS:
            on_progress(f"{name}: drawing a picture ...")
        for ended in as_completed(tried):
            item = ended.result()
            on_progress(f"{item.name}: {'works' if item.works else 'does not work'}, {item.detail}")
        on_progress("drivers and packages ...")
        return DoctorReport(
            system=f"{_system()}, {platform.machine()}, Python {platform.python_version()}",
            renderers=tuple(ended.result() for ended in tried),
            packages=tuple(
                (extra, name, _version(name)) for extra, names in PACKAGES.items() for name in names
            ),
            drivers=tuple(drivers.result()),
        )


def _try(backend: str) -> Renderer:
    if backend == "maniskill" and find_spec("mani_skill") is None:
        return _broken(backend, "not installed (many objects at once, for a CUDA GPU)")
    return probe(backend)


def render(found: DoctorReport) -> Group:
    """The report as tables to print with rich."""
    renderers = Table("renderer", "works", "device, or why not", "to get it", title=found.system)
    for item in found.renderers:
        works = "[green]yes[/]" if item.works else "[red]no[/]"
        renderers.add_row(item.name, works, Text(item.detail), Text(item.remedy))
    drivers = Table("driver", "found", title="Drivers")
    for row in found.drivers:
        drivers.add_row(*(Text(cell) for cell in row))
    packages = Table("extra", "package", "version", title="Packages")
    for extra, name, version in found.packages:
        packages.add_row(extra, name, version or "[dim]not installed[/]")
    used = found.backend
    verdict = (
        f"`--backend auto` is {used} here."
        if used
        else "Nothing renders here: only `--protocol full`, which needs no pictures, works."
    )
    return Group(renderers, drivers, packages, verdict)


def probe(backend: str, timeout: float = PROBE_SECONDS) -> Renderer:
    """Draw the cube with `sapien` or `raycast` in a process of its own.

    Args:
        backend: Name of the renderer.
        timeout: s, after which it counts as broken.
    """
    command = [sys.executable, "-m", "sim_assets.rendering.probe", backend]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=timeout, check=False, env=_quiet()
        )
    except subprocess.TimeoutExpired:
        return _broken(backend, f"no picture within {timeout:g} s")
    if done.returncode == 0:
        return Renderer(
            name=backend, works=True, detail=json.loads(done.stdout.splitlines()[-1]), remedy=""
        )
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    last = lines[-1] if lines else "no message"
    how = f"signal {-done.returncode}" if done.returncode < 0 else f"status {done.returncode}"
    return _broken(
        backend, last if done.returncode == 1 else f"the process ended with {how}: {last}"
    )


def _quiet() -> dict[str, str]:
    return {**os.environ, "PYTHONWARNINGS": "ignore", "OMP_NUM_THREADS": "1"}


def _broken(backend: str, detail: str) -> Renderer:
    return Renderer(name=backend, works=False, detail=detail, remedy=remedy(backend))


def remedy(backend: str) -> str:
    """The command that supplies what this renderer lacks here."""
    package = {"sapien": "sapien", "raycast": "embreex", "maniskill": "mani_skill"}[backend]
    extra = "gpu-sim" if backend == "maniskill" else "sim"
    if find_spec(package) is None:
        if not _has_wheels():
            return f"none: {package} has no wheel for {platform.system()} on {platform.machine()}"
        if not SCRIPT.exists():
            return f"pip install 'scapo[{extra}]'"
        return "make setup LOCK=requirements-all.lock" if extra == "gpu-sim" else "make setup"
    return _driver_remedy() if backend == "sapien" else ""


def _has_wheels() -> bool:
    machine = (platform.system(), platform.machine())
    return machine in {("Linux", "x86_64"), ("Darwin", "arm64")}


def _driver_remedy() -> str:
    if shutil.which("nvidia-smi") and not any("nvidia" in path.name for path in _icds()):
        return "in a container: run it with -e NVIDIA_DRIVER_CAPABILITIES=all"
    if not shutil.which("apt-get"):
        return "install a Vulkan driver (Mesa 24.3 or later, or the GPU's own)"
    if SCRIPT.exists():
        return "make vulkan" if os.geteuid() == 0 else "sudo make vulkan"
    sudo = "" if os.geteuid() == 0 else "sudo "
    suite = "-t bookworm-backports " if _release().get("VERSION_CODENAME") == "bookworm" else ""
    return f"{sudo}apt-get install {suite}libvulkan1 libx11-6 {MESA_PACKAGE}"


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _system() -> str:
    return _release().get("PRETTY_NAME", f"{platform.system()} {platform.release()}")


def _release() -> dict[str, str]:
    try:
        return platform.freedesktop_os_release()
    except OSError:
        return {}


def _icds() -> list[Path]:
    """Vulkan driver manifests, by the loader's own rules for the system's folders."""
    named = os.environ.get("VK_ICD_FILENAMES") or os.environ.get("VK_DRIVER_FILES")
    if named:
        return [Path(name) for name in named.split(os.pathsep)]
    return sorted(path for folder in ICD_FOLDERS for path in Path(folder).glob("*.json"))


def _drivers() -> list[tuple[str, str]]:
    import torch

    icds = ", ".join(path.stem for path in _icds())
    return [
        ("Vulkan drivers", icds or "none"),
        ("Mesa", _output("dpkg-query", "-W", "-f=${Version}", MESA_PACKAGE) or "none"),
        (
            "NVIDIA",
            _output("nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader")
            or "none",
        ),
        ("CUDA of torch", torch.version.cuda or "none (CPU build)"),
        ("CUDA device", torch.cuda.get_device_name() if torch.cuda.is_available() else "none"),
    ]


def _output(*command: str) -> str:
    """What a program prints, on one line; empty where it is missing or fails."""
    if shutil.which(command[0]) is None:
        return ""
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    return " | ".join(done.stdout.split("\n")).strip(" |") if done.returncode == 0 else ""
