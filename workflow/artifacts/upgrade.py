"""Bring the manifests of an earlier schema up to date, without computing anything again.

Schema iif.stage/1 had no seal, and its inputs had no scene. Before a manifest is written anew, every file that it lists is hashed
and each of its inputs is looked for, so that what is sealed is what was written.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from iif_core.errors import InputError
from workflow.artifacts import files as io
from workflow.artifacts import locks, stamps
from workflow.artifacts import manifest as manifests
from workflow.artifacts.manifest import EARLIER_SCHEMA, MANIFEST, STAGE_SCHEMA
from workflow.artifacts.sound import wrong_files
from workflow.artifacts.store import command
from workflow.registry import SHARED, STAGES


def upgrade(results: Path = Path("results"), scenes: list[str] | None = None) -> Iterator[tuple[bool, str]]:
    """Upgrade the stages of scenes, upstream stages first. A killed upgrade continues when it is called again.

    Args:
        results: folder of the results.
        scenes: which; None = all. Stages of other scenes are looked up and not changed.

    Yields:
        Whether it was upgraded, and a line, for each manifest of the earlier schema. One that was not is left as it is.
    """
    found: dict[str, tuple[str, str]] = {}  # digest of the earlier or present manifest -> scene, digest of the present one
    for stage in STAGES:
        for path in sorted(results.glob(f"*/{stage}/{MANIFEST}")):
            scene, digest = path.parents[1].name, io.sha256_of(path)
            found[digest] = (scene, digest)
            try:
                document = json.loads(path.read_bytes())
                schema = document["schema"]
            except (OSError, ValueError, KeyError, TypeError, RecursionError):
                continue  # `verify` names it
            earlier = document.get("upgraded_from")
            if schema == STAGE_SCHEMA and isinstance(earlier, dict):
                found[str(earlier.get("manifest_sha256"))] = (scene, digest)
            if schema != EARLIER_SCHEMA or (scenes and scene not in scenes):
                continue
            try:
                with locks.alone(results, scene, stage):
                    problem = _sealed_anew(path, document, scene, stage, digest, found)
            except InputError as error:
                yield False, str(error)
                continue
            if problem:
                yield False, f"{problem}; rebuild with: {command(scene, stage, document.get('quality'))}"
            else:
                found[digest] = (scene, io.sha256_of(path))
                yield True, f"{path}: {EARLIER_SCHEMA} -> {STAGE_SCHEMA}"


def _sealed_anew(path: Path, document: dict[str, Any], scene: str, stage: str, digest: str, found: dict[str, Any]) -> str:
    """Write the manifest in the present schema, with the time stamp that it had, or return what is in the way of that."""
    if (document.get("scene"), document.get("stage")) != (scene, stage):
        return f"{path}: it belongs to stage {document.get('stage')} of scene {document.get('scene')}, and was put here"
    try:
        problem = next(wrong_files(path.parent, document), "")
        if problem:
            return problem
        inputs = {}
        for name, facts in document["inputs"].items():
            home, present = found[facts["manifest_sha256"]]
            if not (path.parents[2] / home / name.removeprefix(SHARED) / MANIFEST).is_file():
                raise KeyError(name)
            inputs[name] = {**facts, "scene": home, "manifest_sha256": present}
    except (KeyError, TypeError, AttributeError) as error:
        return f"{path}: it was made from a stage that is not there any more, or lacks a key ({error})"
    status = path.stat()
    provenance = {"schema": EARLIER_SCHEMA, "manifest_sha256": digest}
    manifests.write(path, {**document, "schema": STAGE_SCHEMA, "inputs": inputs, "upgraded_from": provenance})
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    stamps.stamp_stage(path.parents[2], scene, stage)
    return ""
