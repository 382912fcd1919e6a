"""Stages in a folder of their own, with settings that are given: for captures, artefacts and settings changed on purpose."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from workflow import settings as settings_module
from workflow.artifacts import StageReader, StageWriter
from workflow.runtime.job import Job, Planned
from workflow.settings.scene import SceneSettings


def document_of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the whole settings tree of some settings over the defaults."""
    return dict(settings_module.dump(SceneSettings.model_validate(settings)))


def changed(document: Mapping[str, Any], sections: Mapping[str, Any]) -> dict[str, Any]:
    """Return a settings tree with some keys of some sections changed, whatever the schema says of them."""
    new = {key: {**document[key], **own} if isinstance(own, Mapping) else own for key, own in sections.items()}
    return {**document, **new}


class Loose(Planned):
    """Stages that lie in the subfolders of one folder. That they fit together is not checked.

    Args:
        folder: with a subfolder for each stage.
        document: settings tree of all stages.
        scene: name of the scene that the manifests have.
        written: where stages are written, if not in the same folder.
    """

    MARK = "0" * 16
    """Fingerprint of all stages."""

    def __init__(self, folder: Path, document: Mapping[str, Any], scene: str = "free", written: Path | None = None):
        self.folder, self.document, self.scene, self.written = folder, document, scene, written or folder

    def job(self, stage: str, threads: int = 1) -> Job:
        """Return the job of a stage."""
        return Job(stage, self.scene, "draft", threads, scenes=self)

    def open(self, stage: str) -> StageReader:
        """Return the reader of a finished stage."""
        return StageReader(self.folder / stage, stage, self.scene)

    def plant(self, stage: str, **provenance: Any) -> StageWriter:
        """Return the writer of a stage that no job makes; `provenance` is added to its manifest."""
        facts = {"scene": self.scene, "stage": stage, "fingerprint": self.MARK, **provenance}
        return StageWriter(self.folder / stage, facts)

    def settings(self, scene: str, quality: str) -> dict[str, Any]:
        return copy.deepcopy(dict(self.document))

    def fingerprint(self, stage: str, scene: str, quality: str) -> str:
        return self.MARK

    def raw(self, stage: str, document: dict[str, Any]) -> dict[str, str]:
        return {}

    def directory(self, stage: str, scene: str) -> Path:
        return self.written / stage

    def reader(self, stage: str, scene: str, quality: str) -> StageReader:
        return self.open(stage)
