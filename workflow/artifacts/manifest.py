"""Manifests: what a finished stage or a deliverable wrote, as sealed JSON of one possible spelling.

`json.dumps(document, indent=1, sort_keys=True)` makes the text; its key `seal` is the SHA-256 of the text without that key. So a
change of any byte shows.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any

import pydantic

from workflow.artifacts.files import read_record, write_atomically

MANIFEST = "manifest.json"
STAGE_SCHEMA = "iif.stage/2"
SCENE_SCHEMA = "iif.scene/2"
_SEAL = b'\n "seal": "'


class Broken(ValueError):
    """A manifest is not what was written; the message says what is wrong, without the path."""


class _Form(pydantic.BaseModel, strict=True, extra="allow"):
    pass


class _File(_Form):
    sha256: str
    bytes: int
    shape: list[Annotated[int, pydantic.Field(ge=0, lt=1 << 40)]] = []


class _Input(_Form):
    scene: str
    manifest_sha256: str


class _Manifest(_Form):
    """What readers rely on, and only somebody who forges a manifest can leave out."""

    files: dict[str, _File]
    inputs: dict[str, _Input] = {}
    manifests: dict[str, str] = {}
    fingerprints: dict[str, str] = {}
    stage: str | None = None
    scene: str | None = None
    quality: str | None = None
    fingerprint: str | None = None


class _Part(_Form):
    by: str
    files: dict[str, _File]
    facts: Any


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
    _compare(data)
    return {key: value for key, value in document.items() if key != "seal"}


def _object(data: bytes) -> dict[str, Any]:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise Broken(f"not readable as JSON ({error})") from None
    if not isinstance(document, dict):
        raise Broken(f"not readable as JSON (an object is needed, found {type(document).__name__})")
    return document


def _compare(data: bytes) -> None:
    """Compare the seal with the rest of the text, which is what stood there before the line of the seal was put in."""
    start = data.rfind(_SEAL)
    end = data.find(b"\n", start + 1)
    seal, after = data[start + len(_SEAL) : end].removesuffix(b",").removesuffix(b'"'), data[end - 1 : end] == b","
    if start > 0 and end > 0 and data.count(_SEAL) == 1:
        before = data[:start] if after else data[:start].removesuffix(b",")
        if hashlib.sha256(before + data[end:]).hexdigest().encode() == seal:
            return
    raise Broken("its content changed since it was written (its seal does not fit)")


def _check(document: Any, form: type[_Form]) -> dict[str, Any]:
    try:
        form.model_validate(document)
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise Broken(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    return document


def parse(data: bytes, schema: str) -> dict[str, Any]:
    """Return the content of a manifest.

    Args:
        data: of the file.
        schema: that this version reads.

    Raises:
        Broken: it is no JSON object, has another schema, was changed since it was written, or lists no files.
    """
    document = _object(data)
    if document.get("schema") != schema:
        raise Broken(f"schema {document.get('schema')!r}, this version reads {schema!r}")
    _compare(data)
    return _check(document, _Manifest)


def part(document: Any) -> dict[str, Any]:
    """Return the note of a finished part of a stage: `by`, `files` as in a manifest, and `facts`.

    Raises:
        Broken: it is not of the form that stages write.
    """
    return _check(document, _Part)


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
    except (OSError, ValueError) as error:
        raise Broken(f"not readable ({getattr(error, 'strerror', error)})") from None
    return parse(data, schema), hashlib.sha256(data).hexdigest()
