# SPDX-License-Identifier: MIT
"""What `scapo-data doctor` says, and that it survives a renderer that ends its process."""

from __future__ import annotations

import io
import sys
from importlib import metadata
from pathlib import Path

import pytest
from rich.console import Console

from sim_assets.rendering import doctor
from sim_assets.rendering.doctor import DoctorReport, Renderer


def text_of(report: DoctorReport) -> str:
    console = Console(file=io.StringIO(), width=200)
    console.print(doctor.render(report))
    return console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]


def renderer(name: str, works: bool = True, remedy: str = "") -> Renderer:
    return Renderer(name=name, works=works, detail=f"about {name}", remedy=remedy)


def report(*renderers: Renderer) -> DoctorReport:
    return DoctorReport(
        system="here", renderers=renderers, packages=(("core", "torch", "2.6"),), drivers=()
    )


@pytest.fixture
def interpreter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Replace Python by a shell script in the processes that probe."""

    def replace(script: str) -> None:
        program = tmp_path / "python"
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(program))

    return replace


def test_ray_casting_is_probed_for_real():
    pytest.importorskip("embreex")
    found = doctor.probe("raycast")
    assert found.works, found.detail
    assert metadata.version("embreex") in found.detail
    assert found.remedy == ""


@pytest.mark.render
def test_sapien_is_probed_for_real():
    pytest.importorskip("sapien")
    found = doctor.probe("sapien")
    if not found.works:
        pytest.skip(f"SAPIEN does not render here: {found.detail}")
    assert metadata.version("sapien") in found.detail


def test_a_renderer_that_is_killed_is_reported(interpreter):
    interpreter("echo before the end >&2; kill -SEGV $$")
    found = doctor.probe("sapien")
    assert not found.works
    assert found.detail == "the process ended with signal 11: before the end"


def test_a_gpu_assert_is_reported(interpreter):
    interpreter("exit 35")
    assert doctor.probe("sapien").detail == "the process ended with status 35: no message"


def test_an_exception_is_its_last_line(interpreter):
    interpreter("echo Traceback >&2; echo 'RenderError: no device' >&2; exit 1")
    assert doctor.probe("sapien").detail == "RenderError: no device"


def test_a_renderer_that_hangs_is_reported(interpreter):
    interpreter("exec sleep 30")
    found = doctor.probe("raycast", timeout=0.2)
    assert (found.works, found.detail) == (False, "no picture within 0.2 s")


@pytest.mark.parametrize(
    ("works", "backend"),
    [((True, True), "sapien"), ((False, True), "raycast"), ((False, False), None)],
)
def test_auto_is_the_first_that_works(works: tuple[bool, bool], backend: str | None):
    found = report(renderer("sapien", works[0]), renderer("raycast", works[1]))
    assert found.backend == backend
    assert (f"auto` is {backend} here" in text_of(found)) == (backend is not None)


def test_maniskill_is_tried_only_where_it_is_installed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "probe", renderer)
    monkeypatch.setattr(doctor, "find_spec", lambda name: name)
    assert doctor._try("maniskill").works
    monkeypatch.setattr(doctor, "find_spec", lambda name: None)
    found = doctor._try("maniskill")
    assert not found.works
    assert "not installed" in found.detail


def test_maniskill_is_never_chosen_by_itself():
    assert report(renderer("sapien", False), renderer("maniskill")).backend is None


def test_brackets_are_printed():
    assert "pip install 'scapo[sim]'" in text_of(
        report(renderer("sapien", False, "pip install 'scapo[sim]'"))
    )


@pytest.mark.parametrize(
    ("checkout", "backend", "expected"),
    [
        (True, "sapien", "make setup"),
        (True, "maniskill", "make setup LOCK=requirements-all.lock"),
        (False, "raycast", "pip install 'scapo[sim]'"),
        (False, "maniskill", "pip install 'scapo[gpu-sim]'"),
    ],
)
def test_missing_packages(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, checkout: bool, backend: str, expected: str
):
    monkeypatch.setattr(doctor, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor, "_has_wheels", lambda: True)
    monkeypatch.setattr(doctor, "SCRIPT", tmp_path if checkout else tmp_path / "absent")
    assert doctor.remedy(backend) == expected


def test_no_command_where_there_is_no_wheel(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor.platform, "system", lambda: "Linux")
    monkeypatch.setattr(doctor.platform, "machine", lambda: "aarch64")
    assert doctor.remedy("sapien") == "none: sapien has no wheel for Linux on aarch64"


@pytest.mark.parametrize(
    ("programs", "checkout", "root", "expected"),
    [
        ({"apt-get"}, True, True, "make vulkan"),
        ({"apt-get"}, True, False, "sudo make vulkan"),
        (
            {"apt-get"},
            False,
            False,
            "sudo apt-get install -t bookworm-backports libvulkan1 libx11-6 mesa-vulkan-drivers",
        ),
        (set(), True, False, "install a Vulkan driver (Mesa 24.3 or later, or the GPU's own)"),
        (
            {"apt-get", "nvidia-smi"},
            True,
            True,
            "in a container: run it with -e NVIDIA_DRIVER_CAPABILITIES=all",
        ),
    ],
)
def test_missing_driver(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    programs: set[str],
    checkout: bool,
    root: bool,
    expected: str,
):
    monkeypatch.setattr(doctor, "find_spec", lambda name: name)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: name if name in programs else None)
    monkeypatch.setattr(doctor.os, "geteuid", lambda: 0 if root else 1000)
    monkeypatch.setattr(doctor, "SCRIPT", tmp_path if checkout else tmp_path / "absent")
    monkeypatch.setattr(doctor, "_release", lambda: {"VERSION_CODENAME": "bookworm"})
    monkeypatch.setattr(doctor, "_icds", lambda: [Path("lvp_icd.x86_64.json")])
    assert doctor.remedy("sapien") == expected


def test_drivers_named_by_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("VK_ICD_FILENAMES", f"{tmp_path / 'mine.json'}:{tmp_path / 'other.json'}")
    assert ("Vulkan drivers", "mine, other") in doctor._drivers()


def test_report_lists_what_is_installed(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(doctor, "probe", renderer)
    lines: list[str] = []
    found = doctor.report(lines.append)
    assert lines[0] == "sapien: drawing a picture ..."
    assert "raycast: works, about raycast" in lines
    versions = {name: version for _, name, version in found.packages}
    assert versions["torch"] == metadata.version("torch")
    assert [item.name for item in found.renderers] == ["sapien", "raycast", "maniskill"]
    printed = text_of(found)
    assert all(name in printed for name in versions)
    assert metadata.version("numpy") in printed
