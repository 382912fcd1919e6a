"""Manifests: what a finished stage or a deliverable wrote, as sealed JSON of one possible spelling.

`json.dumps(document, indent=1, sort_keys=True)` makes the text; its key `seal` is the SHA-256 of the text without that key. A
file was changed if any byte differs from what `json.dumps` makes of its content, or if its seal does not fit the rest.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from workflow.artifacts.files import read_record, write_atomically

MANIFEST = "manifest.json"
STAGE_SCHEMA = "iif.stage/2"
EARLIER_SCHEMA = "iif.stage/1"
"""Without a seal and without the scene of inputs; `workflow.artifacts.upgrade` brings it up to date."""
SCENE_SCHEMA = "iif.scene/2"
EARLIER_SCENE_SCHEMA = "iif.scene/1"


class Broken(ValueError):
    """A manifest is not what was written; the message says what is wrong, without the path."""


def text_of(document: dict[str, Any]) -> str:
    """Return the text of a manifest with its seal; a seal that `document` has is replaced.

    Raises:
        ValueError: a number that is not finite.
    """
    body = {key: value for key, value in document.items() if key != "seal"}
    return _spelled({**body, "seal": hashlib.sha256(_spelled(body).encode()).hexdigest()})


def _spelled(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n"


def write(path: Path, document: dict[str, Any], settled: bool = True) -> None:
    """Write a document with its seal, in one piece. `settled` is as in `write_atomically`."""
    text = text_of(document)
    write_atomically(path, lambda temporary: temporary.write_text(text), settled)


def sealed(data: bytes) -> dict[str, Any]:
    """Return the content of a sealed document of any kind, without the seal.

    Raises:
        Broken: it is no JSON object, or was changed since it was written.
    """
    document = _object(data)
    _compare(document, data)
    return {key: value for key, value in document.items() if key != "seal"}


def _object(data: bytes) -> dict[str, Any]:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise Broken(f"not readable as JSON ({error})") from None
    if not isinstance(document, dict):
        raise Broken(f"not readable as JSON (an object is needed, found {type(document).__name__})")
    return document


def _compare(document: dict[str, Any], data: bytes) -> None:
    try:
        text = text_of(document).encode()
    except (ValueError, RecursionError):
        text = b""
    if text != data:
        raise Broken("its content changed since it was written (its seal does not fit)")


def parse(data: bytes, schema: str) -> dict[str, Any]:
    """Return the content of a manifest.

    Args:
        data: of the file.
        schema: that this version reads.

    Raises:
        Broken: it is no JSON object, has another schema, was changed since it was written, or lists no files.
    """
    document = _object(data)
    found = document.get("schema")
    if found != schema:
        older = found in (EARLIER_SCHEMA, EARLIER_SCENE_SCHEMA)
        hint = "; `python -m workflow upgrade` brings artefacts of earlier versions up to date" if older else ""
        raise Broken(f"schema {found!r}, this version reads {schema!r}{hint}")
    _compare(document, data)
    files = document.get("files")
    if not isinstance(files, dict) or not all(
        isinstance(facts, dict) and {"sha256", "bytes"} <= set(facts) for facts in files.values()
    ):
        raise Broken("it lists no files with their hashes")
    if problem := _wrong_facts(document):
        raise Broken(problem)
    return document


def _wrong_files(files: dict[str, Any]) -> str:
    for name, facts in files.items():
        shape = facts.get("shape", [])
        if not isinstance(facts["sha256"], str) or not isinstance(facts["bytes"], int):
            return f"its entry of {name!r} is no hash and size"
        if not isinstance(shape, list) or not all(isinstance(size, int) and 0 <= size < 1 << 40 for size in shape):
            return f"its entry of {name!r} has no shape"
    return ""


def part(document: Any) -> dict[str, Any]:
    """Return the note of a finished part of a stage: `by`, `files` as in a manifest, and `facts`.

    Raises:
        Broken: it is not of the form that stages write.
    """
    if not isinstance(document, dict) or not isinstance(document.get("by"), str) or "facts" not in document:
        raise Broken("it is no note of a part")
    files = document.get("files")
    if not isinstance(files, dict) or not all(isinstance(f, dict) and {"sha256", "bytes"} <= set(f) for f in files.values()):
        raise Broken("it lists no files with their hashes")
    if problem := _wrong_files(files):
        raise Broken(problem)
    return document


def _wrong_facts(document: dict[str, Any]) -> str:
    """Return which entry of a manifest is not of the form that stages write, which only somebody who forges it can change."""
    if problem := _wrong_files(document["files"]):
        return problem
    inputs = document.get("inputs", {})
    if not isinstance(inputs, dict) or not all(
        isinstance(facts, dict) and isinstance(facts.get("scene"), str) and isinstance(facts.get("manifest_sha256"), str)
        for facts in inputs.values()
    ):
        return "its inputs are not stages with their hashes"
    for key in ("manifests", "fingerprints"):
        listed = document.get(key, {})
        if not isinstance(listed, dict) or not all(isinstance(value, str) for value in listed.values()):
            return f"its {key} are no list of hashes"
    for key in ("stage", "scene", "quality", "fingerprint"):
        if not isinstance(document.get(key, ""), str | None):
            return f"its {key} is no text"
    return ""


def read(path: Path, schema: str = STAGE_SCHEMA) -> dict[str, Any]:
    """Return the content of a manifest.

    Raises:
        Broken: as `parse`, or it cannot be read.
    """
    return load(path, schema)[0]


def load(path: Path, schema: str = STAGE_SCHEMA) -> tuple[dict[str, Any], str]:
    """Return the content of a manifest, and the SHA-256 of its file in hexadecimal, of one reading.

    Raises:
        Broken: as `parse`, or it cannot be read.
    """
    try:
        data = read_record(path)
    except OSError as error:
        raise Broken(f"not readable ({error.strerror})") from None
    return parse(data, schema), hashlib.sha256(data).hexdigest()
