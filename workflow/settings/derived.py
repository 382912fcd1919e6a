"""Derived scenes: a scene under other settings, run by the ordinary rules into folders of its own.

`<scene>--<study>-<variant>-s<seed>` is a point of a bench, a plan of relightings, or what a plug-in derives, such as a variant of
a study of the laboratory. `<scene>--s<seed>`, of plug-ins alone, is what all their variants of a scene share.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

from workflow import plugins
from workflow.settings import relight_plans
from workflow.settings.names import scene_path

STUDY = r"[a-z][a-z0-9_]*"  # no hyphen: it ends the study's part of the name
VARIANT = r"[A-Za-z0-9][A-Za-z0-9_-]*"
_DERIVED = re.compile(rf"(?P<scene>[A-Za-z0-9_-]+?)--(?:(?P<study>{STUDY})-(?P<variant>{VARIANT})-)?s(?P<seed>0|[1-9]\d{{0,8}})")
BENCH = "bench"
"""The variants of this study are points of the front, of any scene: `<scene>--bench-p03-s0` (workflow/trade/bench.py)."""
RELIGHT = "relight"
"""The variants of this study are plans of relightings, of any scene: `<scene>--relight-evening-s0`."""
OWN = {BENCH: "the points of the front", RELIGHT: "plans of relightings"}
"""Studies of the product, and what their variants are."""
BENCH_HELD_OUT = {"capture": {"test_every": 8}}
"""Set where the scene holds no photograph out."""


class Derived(NamedTuple):
    """Parts of the name of a derived scene; `study` and `variant` are empty for what all variants of a plug-in share."""

    scene: str
    study: str
    variant: str
    seed: int

    @property
    def added(self) -> bool:
        """Whether a plug-in derives it."""
        return self.study not in OWN


def derived(name: str, root: Path = Path(".")) -> Derived | None:
    """Return the parts of the name of a derived scene; None for a scene with its own file, or for any other name."""
    if "--" not in name or scene_path(name, root).is_file():
        return None
    match = _DERIVED.fullmatch(name)
    if not match:
        return None
    parts = Derived(match["scene"], match["study"] or "", match["variant"] or "", int(match["seed"]))
    return parts if not parts.added or plugins.derived() else None


def layers(parts: Derived, root: Path = Path(".")) -> list[tuple[str, dict[str, Any]]]:
    """Return (place, settings) of the layers that a derived scene puts over the file of its scene, in order."""
    if parts.added:
        return plugins.derived().layers(parts, root)
    return [relight_plans.plan_layer(parts.variant, root)] if parts.study == RELIGHT else []


def file_of_source(parts: Derived, root: Path = Path(".")) -> Path | None:
    """Return the file in which a plug-in has the `source` of a scene that has no file of its own; None if there is none."""
    return plugins.derived().file_of_source(parts.scene, root) if parts.added else None


def bases(name: str, root: Path = Path(".")) -> list[str]:
    """Return the scenes whose folders may hold results that a derived scene shares, the most general first."""
    parts = derived(name, root)
    if parts and parts.added:
        return plugins.derived().bases(parts, root)
    return [parts.scene] if parts and parts.study == RELIGHT else []


def shared_scene(name: str, root: Path = Path(".")) -> str:
    """Return the scene whose stages a stage reads as `shared`: that of the plug-in for what it derives, else the scene itself."""
    parts = derived(name, root)
    return plugins.derived().shared_scene(parts, root) if parts and parts.added else name


def scene_of(study: str, scene: str, variant: str, seed: int) -> str:
    """Return the name of a derived scene.

    >>> scene_of("bench", "kitchen", "p03", 0)
    'kitchen--bench-p03-s0'
    """
    return f"{scene}--{study}-{variant}-s{seed}"
