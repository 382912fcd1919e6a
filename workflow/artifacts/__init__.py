"""The only code that opens artefact files: atomic writing, strict reading, manifests, verification."""

from workflow.artifacts.store import DamagedArtefact, StageReader, StageWriter

__all__ = ["DamagedArtefact", "StageReader", "StageWriter"]
