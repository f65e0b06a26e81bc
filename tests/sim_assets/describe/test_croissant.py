# SPDX-License-Identifier: MIT
"""`croissant.json` against the specifications, which are written out here as lists of fields.

Croissant 1.0: http://mlcommons.org/croissant/1.0, RAI 1.0: http://mlcommons.org/croissant/RAI/1.0.
"""

from __future__ import annotations

import hashlib
import json
import re
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from scapo.store import Split, write_bytes
from sim_assets.describe.card import write_card
from sim_assets.describe.croissant import CROISSANT
from sim_assets.describe.terms import citation, licence, terms
from tests.helpers.made import sample_arrays, write_split

REQUIRED = {
    "@context": dict,
    "@type": str,
    "name": str,
    "description": str,
    "license": str,
    "url": str,
    "creator": dict,
    "datePublished": str,
    "version": str,
    "citeAs": str,
    "distribution": list,
    "recordSet": list,
}
"""Of a data set, with `conformsTo`."""
FILE = ("@id", "name", "contentUrl", "encodingFormat", "sha256", "contentSize")
RAI = {
    "rai:dataCollection": str,
    "rai:dataCollectionType": list,
    "rai:dataAnnotationProtocol": list,
    "rai:dataUseCases": list,
    "rai:dataLimitations": list,
    "rai:dataBiases": list,
    "rai:dataSocialImpact": str,
    "rai:personalSensitiveInformation": list,
    "rai:dataReleaseMaintenancePlan": str,
}
NAMESPACES = {
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "dct": "http://purl.org/dc/terms/",
}


def made(folder: Path, source: str = "procedural", **options: Any) -> Split:
    options = {"source": source, **options}
    split = write_split(
        folder,
        "eyeglasses",
        "train",
        sample_arrays("eyeglasses", 7, 32),
        shard_size=4,
        options=options,
    )
    write_card(split.folder)
    return split


def read(split: Split) -> dict[str, Any]:
    return json.loads((split.folder / CROISSANT).read_text())


@pytest.mark.parametrize("source", ["procedural", "urdf", "their-set"])
def test_what_the_specifications_ask_for_is_there(tmp_path: Path, source: str):
    data = read(made(tmp_path, source))
    for name, kind in {**REQUIRED, **RAI}.items():
        assert isinstance(data[name], kind), name
        assert data[name], name
    assert data["@type"] == "sc:Dataset"
    assert {NAMESPACES["cr"] + "1.0", NAMESPACES["rai"] + "1.0"} == set(data["conformsTo"])
    assert NAMESPACES.items() <= data["@context"].items()
    assert data["@context"]["@vocab"] == NAMESPACES["sc"]
    assert data["@context"]["conformsTo"] == "dct:conformsTo"
    date.fromisoformat(data["datePublished"])
    assert re.fullmatch(r"\d+\.\d+\.\d+", data["version"])
    assert re.fullmatch(r"[A-Za-z0-9_.-]+", data["name"])


def test_every_term_is_in_the_context(tmp_path: Path):
    """A key that neither schema.org nor the context knows would be lost on a reader."""
    data = read(made(tmp_path))
    schema_org = {
        *("name", "description", "license", "url", "version", "datePublished", "creator"),
        *("keywords", "distribution", "contentUrl", "contentSize", "encodingFormat", "sha256"),
        *("variableMeasured", "value"),
    }
    known = {*data["@context"], *schema_org, "@context", "@id", "@type"}

    def keys(value: object) -> set[str]:
        if isinstance(value, dict):
            return set(value).union(*(keys(item) for item in value.values()))
        return set[str]().union(*(keys(i) for i in value)) if isinstance(value, list) else set()

    used = keys({name: value for name, value in data.items() if name != "@context"})
    assert {name for name in used - known if name.split(":")[0] not in NAMESPACES} == set()


def test_files_have_their_hashes_and_sizes(tmp_path: Path):
    split = made(tmp_path)
    files = read(split)["distribution"]
    assert [file["name"] for file in files] == [
        "manifest.json",
        "00000.safetensors",
        "00001.safetensors",
    ]
    for file in files:
        assert set(FILE) <= set(file)
        assert file["@type"] == "cr:FileObject"
        content = (split.folder / file["contentUrl"]).read_bytes()
        assert file["sha256"] == hashlib.sha256(content).hexdigest()
        assert file["contentSize"] == f"{len(content)} B"
        assert "/" in file["encodingFormat"]


def test_the_record_set_reads_the_objects_from_the_manifest(tmp_path: Path):
    split = made(tmp_path)
    data = read(split)
    (records,) = data["recordSet"]
    ids = [file["@id"] for file in data["distribution"]]
    manifest = json.loads((split.folder / "manifest.json").read_text())
    for field in records["field"]:
        assert field["@id"] == f"{records['@id']}/{field['name']}"
        assert field["dataType"] == "sc:Text"
        assert field["source"]["fileObject"]["@id"] in ids
        path = field["source"]["extract"]["jsonPath"]
        match = re.fullmatch(r"\$\.(\w+)\[\*\]\.(\w+)", path)
        assert match is not None
        values = [row[match[2]] for row in manifest[match[1]]]
        assert all(isinstance(value, str) for value in values)
    assert records["key"]["@id"] in {field["@id"] for field in records["field"]}


def test_tensors_are_described_as_they_are(tmp_path: Path):
    split = made(tmp_path)
    told = {row["name"]: row["value"] for row in read(split)["variableMeasured"]}
    (arrays, _) = list(split.shards())
    assert set(told) == set(arrays)
    for name, array in arrays.items():
        shape = array.shape[1:]
        assert told[name] == (f"{array.dtype} {shape}" if shape else str(array.dtype))


def test_it_is_a_function_of_the_data_alone(tmp_path: Path):
    one, two = made(tmp_path / "a"), made(tmp_path / "b/c")
    assert read(one) == read(two)
    assert str(tmp_path) not in (one.folder / CROISSANT).read_text()
    before = (one.folder / CROISSANT).stat().st_mtime_ns
    write_card(one.folder)
    assert (one.folder / CROISSANT).stat().st_mtime_ns == before
    write_bytes(one.folder / CROISSANT, b"{}")
    write_card(one.folder)
    assert read(one) == read(two)


def test_terms_and_citation(tmp_path: Path, repository: Path):
    own, models = (made(tmp_path / name, name).manifest for name in ("procedural", "urdf"))
    assert read(made(tmp_path / "own"))["license"] == "https://spdx.org/licenses/MIT.html"
    assert "MIT" in licence(own)
    assert "MIT" not in licence(models)
    assert "The terms of those models apply" in terms(models)
    text = citation(own)
    assert text.startswith("@misc{")
    assert own.digest[:16] in text
    assert text.count("{") == text.count("}")
    names = re.findall(r'- name: "(.*)"', (repository / "CITATION.cff").read_text())
    assert names[0] in text
