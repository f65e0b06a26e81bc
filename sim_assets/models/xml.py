# SPDX-License-Identifier: MIT
"""From the bytes of a URDF to its XML elements: no entities, no DTD, no network, small repairs."""

from __future__ import annotations

import codecs
import re
from pathlib import Path
from typing import Any

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] - it has no stubs

from sim_assets.models.validate import MAX_URDF_BYTES, Repairs, read_file, refuse

Element = Any
"""lxml's, which has no types."""
_BOMS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_DECLARATION = re.compile(r"\A<\?xml\b(.*?)\?>", re.DOTALL)
_PREFIX = re.compile(r"(?:</?|\s)([A-Za-z_][\w.-]*):[A-Za-z_][\w.-]*(?=[\s=/>])")


def read_xml(path: Path, repairs: Repairs) -> Element:
    """The `<robot>` element of a file.

    A byte order mark, white space before the declaration, a version that does not exist,
    double hyphens in comments and undeclared namespace prefixes are put right.

    Raises:
        AssetError: No file, too large, no text, a DTD or entities, broken XML, no `<robot>`.
    """
    text = _text(read_file(path, MAX_URDF_BYTES), path, repairs)
    text = _without_declaration(text, repairs)
    text = _without_comments(text, repairs)
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise refuse(path, "XML without a DTD", "a document type or entity declaration")
    if not text.strip():
        raise refuse(path, "a URDF", "an empty file")
    root = _parse(text, path, repairs)
    if local(root) != "robot":
        raise refuse(path, "the root element <robot>", f"<{local(root)}>")
    if "xacro" in text and any(_is_xacro(element) for element in root.iter()):
        raise refuse(path, "an expanded URDF", "xacro macros")
    return root


def local(element: Element) -> str:
    """An element's tag without its namespace; empty for comments and instructions."""
    return etree.QName(element).localname if isinstance(element.tag, str) else ""


def children(element: Element, tag: str) -> list[Element]:
    """Child elements of this tag, whatever their namespace."""
    return [child for child in element if local(child) == tag]


def _is_xacro(element: Element) -> bool:
    space = etree.QName(element).namespace if isinstance(element.tag, str) else None
    return space is not None and "xacro" in space


def _text(data: bytes, path: Path, repairs: Repairs) -> str:
    encoding = "utf-8"
    for mark, name in _BOMS:
        if data.startswith(mark):
            repairs.add("A byte order mark was dropped")
            data, encoding = data[len(mark) :], name
            break
    else:
        declared = re.match(rb"\s*<\?xml[^>]*encoding\s*=\s*[\"']([\w.-]+)[\"']", data)
        encoding = declared[1].decode() if declared else encoding
    try:
        return data.decode(encoding)
    except (LookupError, UnicodeDecodeError) as error:
        raise refuse(path, f"text in {encoding}", str(error)) from error


def _without_declaration(text: str, repairs: Repairs) -> str:
    stripped = text.lstrip()
    found = _DECLARATION.match(stripped)
    if found is None:
        return stripped
    if stripped != text:
        repairs.add("White space before the XML declaration was dropped")
    version = re.search(r"version\s*=\s*[\"']([^\"']*)[\"']", found[1])
    if version is None or version[1] not in ("1.0", "1.1"):
        number = repr(version[1]) if version else "none"
        repairs.add(f"The XML version {number} was read as '1.0'")
    return stripped[found.end() :]


def _without_comments(text: str, repairs: Repairs) -> str:
    kept, end = [], 0
    while (start := text.find("<!--", end)) >= 0 and (close := text.find("-->", start + 4)) >= 0:
        comment = text[start + 4 : close]
        if "--" in comment or comment.endswith("-"):
            repairs.add("Comments with double hyphens were dropped")
        kept.append(text[end:start])
        end = close + 3
    return "".join((*kept, text[end:]))


def _parse(text: str, path: Path, repairs: Repairs) -> Element:
    try:
        return _fromstring(text)
    except etree.XMLSyntaxError as error:
        if "Namespace prefix" not in str(error):
            raise refuse(path, "well-formed XML", str(error)) from error
    declared = set(re.findall(r"xmlns:([\w.-]+)\s*=", text)) | {"xml", "xmlns"}
    missing = sorted(set(_PREFIX.findall(text)) - declared)
    spaces = "".join(f' xmlns:{prefix}="undeclared:{prefix}"' for prefix in missing)
    text = re.sub(r"<([A-Za-z_][\w.:-]*)", lambda tag: tag[0] + spaces, text, count=1)
    repairs.add(f"Undeclared namespace prefixes were declared: {', '.join(missing)}")
    try:
        return _fromstring(text)
    except etree.XMLSyntaxError as error:
        raise refuse(path, "well-formed XML", str(error)) from error


def _fromstring(text: str) -> Element:
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        dtd_validation=False,
        huge_tree=False,
        remove_comments=True,
        remove_pis=True,
    )
    # Encoded anew: lxml refuses `str` with an encoding declaration in some versions.
    return etree.fromstring(text.encode(), parser)
