# SPDX-License-Identifier: MIT
"""`croissant.json` beside every card: the data set as machines read it.

Croissant 1.0 (http://mlcommons.org/croissant/1.0) with the responsible-AI fields
(http://mlcommons.org/croissant/RAI/1.0). Shards are files with their SHA-256; the objects are a
record set that is read from the manifest; the tensors, for which Croissant has no reader, are
described as `variableMeasured`. A function of manifest and shards alone, like the card.
"""

from __future__ import annotations

import json
from typing import Any

from scapo.store import Split
from scapo.store.files import sha256_bytes
from scapo.store.manifest import Manifest
from sim_assets.describe import terms

CROISSANT = "croissant.json"
CONFORMS = ("http://mlcommons.org/croissant/1.0", "http://mlcommons.org/croissant/RAI/1.0")
PUBLISHED = "2026-11-22"
"""Of this format of data; whoever puts a set on the web sets `url` and `datePublished` there."""
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
"""As the specification recommends it, with the responsible-AI prefix."""
MANIFEST = "manifest.json"
MEANING = {
    "points": "Points in the camera frame (x right, y down, z forward), m",
    "color": "RGB of each point",
    "part": "Part of each point; 255: background or unlabelled",
    "camera_T_part": "Pose of each part: part frame to camera frame, m",
    "joint_pivot": "A point on each joint's axis, camera frame, m",
    "joint_axis": "Unit vector of each joint, camera frame",
    "joint_state": "State of each joint from rest, rad or m; NaN: unknown",
    "visible": "Share of each part's surface that is seen; NaN: unknown",
    "sensor": "Centre of the camera, m, for clouds that are not in its frame",
    "camera": "fx, fy, cx, cy, width, height in pixels",
    "instance": "Index into the manifest's list of objects",
}
_USES = "Training and evaluation of category-level pose estimation of articulated objects."
_COLLECTION = {
    "procedural": "Objects are drawn from this project's generators and rendered in simulation.",
    "urdf": "Models from a folder of URDF files are rendered in simulation.",
}
_BIASES = {
    "procedural": "Shapes, joint travel and viewpoints follow the ranges of the generators, which "
    "are those of common household objects; every value in a range is about equally likely, which "
    "it is not among real objects.",
    "urdf": "Shapes are those of the models that were given, which need not stand for the objects "
    "of their category.",
}
_OTHER_COLLECTION = "Recordings of other authors, converted."
_OTHER_BIASES = "Those of the original set."
_LIMITS = (
    "One object at a time, without a scene; labels are those of the simulation or of the original "
    "authors. Results on it are no evidence of safety of a robot near people."
)


def croissant_text(split: Split) -> str:
    """The file: indented JSON, with a final newline."""
    return json.dumps(croissant(split), indent=1, ensure_ascii=False) + "\n"


def croissant(split: Split) -> dict[str, Any]:
    """The description of one split, as JSON-LD."""
    manifest = split.manifest
    own = terms.is_own(manifest)
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": list(CONFORMS),
        "name": f"scapo-{manifest.category}-{manifest.split}",
        "description": _description(manifest),
        "license": terms.LICENCE_URL if own else terms.terms(manifest),
        "url": f"urn:sha256:{manifest.digest}",
        "version": manifest.versions.get("scapo", "0.0.0"),
        "datePublished": PUBLISHED,
        "creator": {"@type": "sc:Organization", "name": terms.CREATOR},
        "citeAs": terms.citation(manifest),
        "keywords": ["articulated objects", "pose estimation", "point clouds", manifest.category],
        "isLiveDataset": False,
        "distribution": _files(split),
        "recordSet": [_objects(manifest)],
        "variableMeasured": _tensors(split),
        **_responsible(manifest),
    }


def _description(manifest: Manifest) -> str:
    return (
        f"{manifest.count} labelled point clouds of {len(manifest.instances)} objects of the "
        f"category {manifest.category} (parts: {', '.join(manifest.parts)}), split "
        f"{manifest.split}, {manifest.points} points each, with part labels, part poses and joints."
    )


def _files(split: Split) -> list[dict[str, Any]]:
    path = split.folder / MANIFEST
    data = path.read_bytes()
    files = [_file(MANIFEST, len(data), sha256_bytes(data), "application/json")]
    for shard in split.manifest.shards:
        size = (split.folder / shard.file).stat().st_size
        files.append(_file(shard.file, size, shard.sha256, "application/octet-stream"))
    return files


def _file(name: str, size: int, sha256: str, kind: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "contentSize": f"{size} B",
        "encodingFormat": kind,
        "sha256": sha256,
    }


def _objects(manifest: Manifest) -> dict[str, Any]:
    """The manifest's objects as records."""
    told = {"id": "Name of the object", "source": "Where it came from", "sha256": "Of its files"}
    fields = [
        {
            "@type": "cr:Field",
            "@id": f"objects/{name}",
            "name": name,
            "description": text,
            "dataType": "sc:Text",
            "source": {
                "fileObject": {"@id": MANIFEST},
                "extract": {"jsonPath": f"$.instances[*].{name}"},
            },
        }
        for name, text in told.items()
    ]
    return {
        "@type": "cr:RecordSet",
        "@id": "objects",
        "name": "objects",
        "description": f"The {len(manifest.instances)} objects that the samples show.",
        "key": {"@id": "objects/id"},
        "field": fields,
    }


def _tensors(split: Split) -> list[dict[str, Any]]:
    """The tensors of the first shard, others than ours too: dtype and shape of one sample."""
    arrays = next(split.shards(), {})
    rows = []
    for name in (*(n for n in MEANING if n in arrays), *sorted(set(arrays) - set(MEANING))):
        shape, dtype = arrays[name].shape[1:], arrays[name].dtype
        row = {
            "@type": "sc:PropertyValue",
            "name": name,
            "description": MEANING.get(name, "See the documentation of the set"),
            "value": f"{dtype} {tuple(shape)}" if shape else f"{dtype}",
        }
        rows.append(row)
    return rows


def _responsible(manifest: Manifest) -> dict[str, Any]:
    source = str(manifest.options.get("source"))
    simulated = source in _COLLECTION
    labels = "by the simulation that made the points" if simulated else "by the original authors"
    left = manifest.statistics.get("samples_lost", 0) or manifest.statistics.get("files_refused", 0)
    return {
        "rai:dataCollection": _COLLECTION.get(source, _OTHER_COLLECTION),
        "rai:dataCollectionType": ["Simulations" if simulated else "Others"],
        "rai:dataCollectionMissingData": f"{left:.0f} samples or files were left out.",
        "rai:dataAnnotationProtocol": [f"Labels are given {labels}, none by hand here."],
        "rai:dataPreprocessingProtocol": [
            "Options, versions and digests of what made the data are in the manifest."
        ],
        "rai:dataUseCases": [_USES],
        "rai:dataLimitations": [_LIMITS],
        "rai:dataBiases": [_BIASES.get(source, _OTHER_BIASES)],
        "rai:dataSocialImpact": "Helps robots and assistants to handle household objects.",
        "rai:personalSensitiveInformation": [
            "None: no person is shown or recorded."
            if simulated
            else "See the original set; clouds of objects only are kept."
        ],
        "rai:dataReleaseMaintenancePlan": (
            "A change of the data is a change of its digest; older versions are made again by the "
            "commit that made them."
        ),
    }
