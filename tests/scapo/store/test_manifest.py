# SPDX-License-Identifier: MIT
"""Manifests: round trip, and a refusal for each field that is missing or contradictory."""

from __future__ import annotations

import json
import os
import time
from dataclasses import MISSING, FrozenInstanceError, fields, replace
from pathlib import Path

import pytest

from scapo.categories import JointSpec
from scapo.store.manifest import (
    Instance,
    Manifest,
    ManifestError,
    Shard,
    read_manifest,
    shards_digest,
)
from scapo.store.split import open_split
from tests.helpers.splits import edit_manifest, instance, write_split


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The manifest of eyeglasses in three shards, as JSON."""
    folder = write_split(tmp_path_factory.mktemp("split"), "eyeglasses")
    return (folder / "manifest.json").read_text()


@pytest.fixture
def folder(tmp_path: Path, written: str) -> Path:
    (tmp_path / "manifest.json").write_text(written)
    return tmp_path


def refuse(folder: Path, message: str) -> None:
    path = folder / "manifest.json"
    with pytest.raises(ManifestError) as caught:
        read_manifest(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


def test_round_trip(folder: Path, written: str) -> None:
    manifest = read_manifest(folder / "manifest.json")
    assert manifest.to_json() == written
    assert manifest == read_manifest(str(folder / "manifest.json"))
    assert manifest.count == 8
    assert manifest.joints[1] == JointSpec(
        kind="revolute", parent=0, child=2, lower=0.0, upper=manifest.joints[0].upper
    )
    assert [shard.first for shard in manifest.shards] == [0, 3, 4]
    assert manifest.instances[2] == instance(2, 2)
    with pytest.raises(FrozenInstanceError):
        manifest.count = 3  # pyright: ignore[reportAttributeAccessIssue]


def test_json_is_sorted_and_tagged(written: str) -> None:
    data = json.loads(written)
    assert data["format"] == "scapo-manifest/1"
    assert list(data) == sorted(data)
    assert written.endswith("}\n")


def test_numbers_that_json_lacks_are_not_written(folder: Path) -> None:
    manifest = read_manifest(folder / "manifest.json")
    with pytest.raises(ValueError, match="not JSON compliant"):
        replace(manifest, statistics={"redrawn": float("nan")}).to_json()


def test_unknown_fields_are_left_to_later_versions(folder: Path) -> None:
    before = read_manifest(folder / "manifest.json")
    edit_manifest(folder, colour="blue")
    assert read_manifest(folder / "manifest.json") == before


def test_statistics_may_be_absent(folder: Path) -> None:
    edit_manifest(folder, statistics=...)
    assert read_manifest(folder / "manifest.json").statistics == {}


REQUIRED = [field.name for field in fields(Manifest) if field.default_factory is MISSING]


@pytest.mark.parametrize("name", REQUIRED)
def test_a_missing_field_is_refused(folder: Path, name: str) -> None:
    edit_manifest(folder, **{name: ...})
    refuse(folder, f"expected field {name!r}, found none")


@pytest.mark.parametrize(
    ("rows", "record"), [("shards", Shard), ("instances", Instance), ("joints", JointSpec)]
)
def test_a_missing_field_of_a_row_is_refused(folder: Path, rows: str, record: type) -> None:
    data = json.loads((folder / "manifest.json").read_text())
    for field in fields(record):
        if field.default is not MISSING:
            continue
        row = {name: value for name, value in data[rows][1].items() if name != field.name}
        edit_manifest(folder, **{rows: [data[rows][0], row, *data[rows][2:]]})
        refuse(folder, f"{rows}[1]: expected field {field.name!r}, found none")


def test_trait_and_account_are_kept_and_are_not_written_where_there_are_none(folder: Path) -> None:
    path = folder / "manifest.json"
    before = path.read_text()
    manifest = read_manifest(path)
    assert {(row.trait, row.account) for row in manifest.instances} == {("", ())}
    assert manifest.to_json() == before
    assert "trait" not in before
    assert "account" not in before
    told = replace(manifest.instances[0], trait="set back", account=("joint a (door)", "size 1 m"))
    changed = replace(manifest, instances=(told, *manifest.instances[1:]))
    path.write_text(changed.to_json())
    assert read_manifest(path) == changed
    assert json.loads(path.read_text())["instances"][0]["trait"] == "set back"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("count", "8", "count: expected an integer, found '8'"),
        ("count", 8.0, "count: expected an integer, found 8.0"),
        ("count", True, "count: expected an integer, found True"),
        ("points", None, "points: expected an integer, found None"),
        ("points", 0, "points: expected 1 or more, found 0"),
        ("category", 3, "category: expected text, found 3"),
        ("parts", "frame", "parts: expected a list, found 'frame'"),
        ("parts", ["a", 1, "b"], "parts[1]: expected text, found 1"),
        ("parts", ["a", "b", "a"], "expected different parts, found 'a' twice"),
        ("parts", ["a", "b"], "found 2 parts and 2 joints"),
        ("options", [], "options: expected an object, found []"),
        ("versions", {"scapo": 1}, "versions['scapo']: expected text, found 1"),
        ("statistics", {"a": "b"}, "statistics['a']: expected a number, found 'b'"),
        ("joints", {}, "joints: expected a list, found {}"),
        ("joints", ["hinge"], "joints[0]: expected an object, found str"),
        ("shards", None, "shards: expected a list, found None"),
        ("shards", [], "expected count 8, found 0 in shards"),
        ("count", 9, "expected count 9, found 8 in shards"),
        ("digest", 7, "digest: expected text, found 7"),
    ],
)
def test_a_wrong_field_is_refused(folder: Path, name: str, value: object, message: str) -> None:
    edit_manifest(folder, **{name: value})
    refuse(folder, message)


@pytest.mark.parametrize(
    ("rows", "name", "value", "message"),
    [
        ("shards", "first", 4, "expected first 3 and a count of 1 or more, found 4 and 1"),
        ("shards", "count", 0, "expected first 3 and a count of 1 or more, found 3 and 0"),
        ("shards", "count", -1, "expected first 3 and a count of 1 or more, found 3 and -1"),
        ("shards", "count", 2, "expected first 5 and a count of 1 or more, found 4 and 4"),
        ("shards", "file", "../00001.safetensors", "without folders, found '../00001"),
        ("shards", "file", "/etc/passwd", "without folders, found '/etc/passwd'"),
        ("shards", "file", "..", "without folders, found '..'"),
        ("shards", "file", "", "without folders, found ''"),
        ("shards", "file", "00000.safetensors", "found '00000.safetensors' twice"),
        ("shards", "sha256", None, "shards[1]: sha256: expected text, found None"),
        ("joints", "kind", "ball", "expected one of revolute, prismatic, found 'ball'"),
        ("joints", "child", 1, "joints[1]: expected parent 0 and child 2, found 0 and 1"),
        ("joints", "child", 3, "joints[1]: expected parent 0 and child 2, found 0 and 3"),
        ("joints", "parent", 1, "joints[1]: expected parent 0 and child 2, found 1 and 2"),
        ("joints", "lower", 9.0, "joints[1]: expected lower <= upper, found 9.0"),
        ("joints", "upper", None, "joints[1]: upper: expected a number, found None"),
        ("instances", "id", "object-0", "expected different instance ids, found 'object-0' twice"),
        ("instances", "sign", [1], "sign: expected 2 entries, one per joint, found 1"),
        ("instances", "sign", [1, 0.5], "sign: expected 1 or -1, found (1.0, 0.5)"),
        ("instances", "joint_names", ["a"] * 3, "joint_names: expected 2 entries"),
        ("instances", "rest", {"a": "closed"}, "rest['a']: expected a number, found 'closed'"),
        ("instances", "object_T_asset", [[1.0]], "expected a 4x4 similarity, found ((1.0,),)"),
    ],
)
def test_a_wrong_field_of_a_row_is_refused(
    folder: Path, rows: str, name: str, value: object, message: str
) -> None:
    data = json.loads((folder / "manifest.json").read_text())
    data[rows][1][name] = value
    edit_manifest(folder, **{rows: data[rows]})
    refuse(folder, message)


@pytest.mark.parametrize(
    "matrix",
    [
        [[0] * 4] * 4,
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]],  # mirrored
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]],  # stretched
        [[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],  # sheared
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]],  # projective
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]],
    ],
)
def test_what_is_no_similarity_is_refused(folder: Path, matrix: list[list[float]]) -> None:
    data = json.loads((folder / "manifest.json").read_text())
    data["instances"][0]["object_T_asset"] = matrix
    edit_manifest(folder, instances=data["instances"])
    refuse(folder, "instances[0]: object_T_asset: expected a 4x4 similarity")


@pytest.mark.parametrize("scale", [1e-3, 1.0, 250.0])
def test_similarities_of_any_scale_pass(folder: Path, scale: float) -> None:
    data = json.loads((folder / "manifest.json").read_text())
    matrix = [[0, -scale, 0, 5], [scale, 0, 0, -1], [0, 0, scale, 0], [0, 0, 0, 1]]
    data["instances"][0]["object_T_asset"] = matrix
    edit_manifest(folder, instances=data["instances"])
    found = read_manifest(folder / "manifest.json").instances[0].object_T_asset
    assert [list(row) for row in found] == matrix


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "expected JSON, found Expecting value"),
        (b"{", "expected JSON, found Expecting"),
        (b"\xff\xfe{", "expected JSON, found 'utf-8' codec"),
        (b"[" * 100_000, "expected JSON, found maximum recursion"),
        (b'{"format": NaN}', "expected JSON, found NaN, which JSON lacks"),
        (b"[]", "expected format 'scapo-manifest/1', found 'list'"),
        (b"{}", "expected format 'scapo-manifest/1', found None"),
        (b'{"format": "scapo-manifest/2"}', "found 'scapo-manifest/2'"),
    ],
)
def test_other_files_are_refused(folder: Path, data: bytes, message: str) -> None:
    (folder / "manifest.json").write_bytes(data)
    refuse(folder, message)


def test_no_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    refuse(tmp_path, "expected a manifest, found no file")
    (tmp_path / "manifest.json").mkdir()
    refuse(tmp_path, "expected a file of its own, found a link, a folder or a device")


def test_other_writers_may_have_a_digest_of_their_own(folder: Path) -> None:
    edit_manifest(folder, digest="v3")
    assert read_manifest(folder / "manifest.json").digest == "v3"


def test_the_digest_is_over_the_hashes_in_order() -> None:
    def shard(sha256: str) -> Shard:
        return Shard(file="a", first=0, count=1, sha256=sha256)

    both = (shard("a"), shard("b"))
    # printf 'a\nb' | sha256sum
    expected = "7e18f737311b2dc3b2f269dd78396b0351f14fb66efa879f768cb23181883c78"
    assert shards_digest(both) == expected != shards_digest(both[::-1])


@pytest.mark.parametrize("kind", ["link", "dangling link", "pipe", "device"])
def test_a_manifest_that_is_no_file_of_its_own_is_refused(kind: str, folder: Path) -> None:
    path = folder / "manifest.json"
    path.rename(folder / "other.json")
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to({"link": "other.json", "device": "/dev/zero"}.get(kind, "none"))
    refuse(folder, "expected a file of its own, found a link, a folder or a device")
    with pytest.raises(ManifestError, match="expected a file of its own"):
        open_split(folder, split=folder.name)


@pytest.mark.parametrize("name", ["category", "split"])
@pytest.mark.parametrize("value", ["../../x", "/etc", "..", "", "a/b", "a\nb", "x" * 300])
def test_names_of_folders_are_no_paths(name: str, value: str, folder: Path) -> None:
    """An export would write outside of its folder."""
    edit_manifest(folder, **{name: value})
    refuse(folder, f"{name}: expected a folder's name, found")


def test_a_shard_that_would_fill_the_memory_is_refused(folder: Path) -> None:
    edit_manifest(folder, points=10**12)
    refuse(folder, "expected at most 16777216 points, found 3 samples of 1000000000000")


def test_a_manifest_of_very_many_objects_is_read_at_once(folder: Path, written: str) -> None:
    first = json.loads(written)["instances"][0]
    edit_manifest(folder, instances=[{**first, "id": str(k)} for k in range(1_000)])
    begun = time.process_time()
    assert len(read_manifest(folder / "manifest.json").instances) == 1_000
    assert time.process_time() - begun < 5
