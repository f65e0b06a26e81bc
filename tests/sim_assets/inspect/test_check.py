# SPDX-License-Identifier: MIT
"""Checking a folder: every model has its line, and none takes another with it."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from scapo.parallel.pool import Outcome, Pool
from sim_assets.inspect import check as room
from sim_assets.inspect.check import Options, check, check_one, exit_code, report, write_report
from sim_assets.models.validate import AssetError
from tests.helpers.urdfs import cabinet


def test_a_folder(tmp_path: Path):
    cabinet(tmp_path / "good")
    cabinet(tmp_path / "mended", ('version="1.0"', 'version="0.0"'))
    cabinet(tmp_path / "bad", ("body.obj", "lost.obj"))
    seen: list[str] = []
    results = check(tmp_path, on_result=lambda result: seen.append(result.path))
    assert [(r.path.split("/")[0], r.status) for r in results] == [
        ("bad", "refused"),
        ("good", "accepted"),
        ("mended", "repaired"),
    ]
    assert sorted(seen) == [r.path for r in results]
    bad, good, mended = results
    assert "lost.obj" in bad.reason
    assert str(tmp_path) not in bad.reason
    assert (good.joints, good.triangles, good.reason) == (("hinge",), 24, "")
    assert mended.repairs == ("The XML version '0.0' was read as '1.0'",)
    assert exit_code(results) == 1
    assert exit_code([good, mended]) == 0
    write_report(results, tmp_path / "report.json")
    data = json.loads((tmp_path / "report.json").read_text())
    assert data == json.loads(json.dumps(report(results)))
    assert data["counts"] == {"accepted": 1, "repaired": 1, "refused": 1}
    assert data["format"] == "scapo-check/1"


def test_with_a_category(tmp_path: Path):
    urdf = cabinet(tmp_path)
    result = check_one(urdf, tmp_path, Options(category="oven"))
    assert (result.status, result.joints) == ("accepted", ("hinge",))
    result = check_one(urdf, tmp_path, Options(category="oven", front="x"))
    assert result.status == "accepted"
    assert check_one(urdf, tmp_path, Options(category="drawer")).status == "refused"
    assert check_one(urdf, tmp_path, Options(category="oven", up="q")).status == "refused"


def test_a_part_that_cannot_be_seen(tmp_path: Path):
    """A door of half a millimetre reads well, but no view gives it its points."""
    urdf = cabinet(tmp_path)
    trimesh.creation.box((0.0005, 0.0005, 0.0005)).export(tmp_path / "meshes/door.obj")
    result = check_one(urdf, tmp_path, Options(category="oven"))
    assert result.status == "refused"
    assert "visible pixels" in result.reason


def test_nothing_that_moves(tmp_path: Path):
    """A joint whose base or child cannot be seen is of no use to any category."""
    limit = ('upper="1.5"', 'upper="0"')
    result = check_one(cabinet(tmp_path, limit), tmp_path, Options())
    assert result.status == "refused"
    assert "travel" in result.reason


def fine_body(folder: Path, count: int) -> None:
    """A cabinet whose body has so many triangles."""
    cabinet(folder, ("body.obj", "large.stl"))
    triangles = np.zeros(count, [("numbers", "<f4", 12), ("attribute", "<u2")])
    triangles["numbers"] = np.random.default_rng(0).normal(size=(count, 12))
    head = b"\0" * 80 + struct.pack("<I", count)
    (folder / "meshes/large.stl").write_bytes(head + triangles.tobytes())


def test_a_model_that_is_given_too_little_memory(tmp_path: Path):
    fine_body(tmp_path / "a", 60_000)
    (starved,) = check(tmp_path, Options(memory=4 << 20))
    assert starved.status == "refused"
    assert "Memory" in starved.reason or "process" in starved.reason
    assert check_one(tmp_path / "a/cabinet.urdf", tmp_path, Options()).status == "accepted"


def test_a_model_of_which_nothing_is_heard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Workers left out: they are said to be silent for as long as the options say."""

    class Silent(Pool[Any, Any]):
        def run(self, function: Any, jobs: Any, *_: Any, **__: Any) -> Iterator[Outcome[Any, Any]]:
            reason = f"no sign of life for {self.timeout:g} s"
            yield from (Outcome(job=j, result=None, failure="hung", reason=reason) for j in jobs)

    monkeypatch.setattr(room, "Pool", Silent)
    cabinet(tmp_path / "a")
    (hung,) = check(tmp_path, Options(timeout=0.2))
    wanted = "a/cabinet.urdf: expected to be read, found that no sign of life for 0.2 s"
    assert (hung.status, hung.reason) == ("refused", wanted)


@pytest.mark.slow
def test_a_model_that_hangs_or_eats_the_memory(tmp_path: Path):
    fine_body(tmp_path / "a", 600_000)
    hung = check(tmp_path, Options(timeout=0.2))
    assert [r.status for r in hung] == ["refused"]
    assert "no sign of life" in hung[0].reason
    starved = check(tmp_path, Options(memory=16 << 20))
    assert [r.status for r in starved] == ["refused"]
    assert "Memory" in starved[0].reason or "process" in starved[0].reason


def test_a_packages_folder_of_urdfs_is_what_paths_are_relative_to(tmp_path: Path):
    """Meshes are found in the package all the same."""
    package = cabinet(tmp_path / "cabinet").parent
    (package / "urdf").mkdir()
    text = (package / "cabinet.urdf").read_text().replace("meshes/", "package://cabinet/meshes/")
    (package / "cabinet.urdf").unlink()
    (package / "urdf/cabinet.urdf").write_text(text)
    (result,) = check(package / "urdf")
    assert (result.path, result.status) == ("cabinet.urdf", "accepted"), result.reason
    assert check(package)[0].path == "urdf/cabinet.urdf"
    assert check(package / "urdf/cabinet.urdf")[0].path == "cabinet.urdf"


@pytest.mark.parametrize("wrong", [{"scale": 0.0}, {"up": "q"}, {"up": "z", "front": "z"}])
def test_options_that_fit_no_model_are_refused_once(tmp_path: Path, wrong: dict[str, Any]):
    cabinet(tmp_path / "one")
    cabinet(tmp_path / "two")
    with pytest.raises(ValueError, match=f"^{list(wrong)[-1]}: expected .*, found"):
        check(tmp_path, Options(category="safe", **wrong))


def test_variants_beside_mobility_urdf_are_no_models_of_their_own(tmp_path: Path):
    text = cabinet(tmp_path).read_text()
    (tmp_path / "mobility.urdf").write_text(text)
    assert [result.path for result in check(tmp_path)] == ["mobility.urdf"]
    assert [result.path for result in check(tmp_path / "cabinet.urdf")] == ["cabinet.urdf"]


def test_no_folder(tmp_path: Path):
    with pytest.raises(AssetError, match="nothing"):
        check(tmp_path / "absent")
