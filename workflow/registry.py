"""The stages, in one table: what each does, needs and reads. workflow/rules/stages.smk makes a rule of every line.

`settings` are dotted paths into the settings tree. A stage can see no others (`Job.settings` refuses), so its fingerprint covers
everything that it can depend on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from workflow import plugins


@dataclass(frozen=True)
class Stage:
    """One stage, which is one rule.

    Attributes:
        name: of the stage, its rule, its module in workflow/stages/ and its folder in results/<scene>/.
        does: one sentence, which `snakemake --list` and a run show.
        upstream: stages whose files it reads.
        settings: dotted paths of the settings that it reads.
        reads_raw: whether files from outside results/ enter here.
        on_demand: whether no scene needs it, only its own target or a plug-in.
        shared: stages whose files it reads in the folder of the scene that all derived scenes of a plug-in share.
        files: modules whose `raw_inputs` know (and check) further input files.
        scores: whether it compares or shows the result, and so may read held-out photographs and ground truth.
        place: name of its module where that is not `workflow.stages.<name>`.
        threads: cores that its job takes, unless a profile says otherwise.
        also: kind of source -> stages that it reads too in scenes of that kind.
    """

    name: str
    does: str
    upstream: tuple[str, ...]
    settings: tuple[str, ...]
    reads_raw: bool = False
    on_demand: bool = False
    shared: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    scores: bool = False
    place: str = ""
    threads: int = 2
    also: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def reads(self, document: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the stages that it reads in a scene with these settings."""
        return (*self.upstream, *dict(self.also).get(document["source"]["kind"], ()))

    @property
    def module(self) -> str:
        return self.place or f"workflow.stages.{self.name}"


_REPORTED = (
    "capture",
    "plan",
    "prior",
    "segmentation",
    "base",
    "emission",
    "shading",
    "second_look",
    "affines",
    "render",
    "metrics",
    "export",
)
"""Stages that the report shows."""

SHARED = "shared_"
"""Begins the name of an input that is a stage of the shared scene, in rules and manifests."""

STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage(
            "reconstruction",
            "Find the cameras of photographs, and a mesh; of scenes that have nothing else.",
            (),
            tuple(f"source.{key}" for key in ("kind", "path", "most", "detail", "colour", "room_height", "camera_height")),
            reads_raw=True,
            on_demand=True,
            files=("workflow.sources.photographs",),
        ),
        Stage(
            "capture",
            "Bring photographs, cameras and mesh into the normal form, or render them.",
            (),
            ("source", "capture", "seed"),
            reads_raw=True,
            also=(("photographs", ("reconstruction",)),),
        ),
        Stage(
            "plan",
            "Find out, from photographs and mesh alone, which parts of the model the scene requires.",
            ("capture",),
            (
                "components.specular",
                "emission.environment",
                "segmentation.kind",
                "seed",
            ),
        ),
        Stage(
            "prior",
            "Predict materials K times for every photograph.",
            ("capture",),
            ("prior", "source", "segmentation.kind", "seed"),
            reads_raw=True,
        ),
        Stage(
            "segmentation",
            "Assign faces of the mesh to objects, and pixels to segments.",
            ("capture", "prior"),
            ("segmentation", "source", "capture"),
            reads_raw=True,
        ),
        Stage(
            "base",
            "Fuse the predictions of all views into one base texture.",
            ("capture", "prior", "segmentation"),
            ("base", "seed"),
        ),
        Stage(
            "emission",
            "Find the emitters and solve for their radiance.",
            ("capture", "prior", "plan", "segmentation", "base"),
            ("emission", "capture.dynamic_range", "affines.response", "seed"),
            reads_raw=True,
            files=("workflow.scene.response_file",),
        ),
        Stage(
            "shading",
            "Trace the light that arrives at every pixel, once for all later fits.",
            ("capture", "plan", "segmentation", "base", "emission"),
            ("shading", "seed"),
        ),
        Stage(
            "second_look",
            "Predict and fuse once more, under the light that was found.",
            ("capture", "prior", "segmentation", "shading"),
            ("second_look", "prior", "segmentation.kind", "base", "seed"),
        ),
        Stage(
            "affines",
            "Fit one affine map per object, and the camera response, to the photographs.",
            ("capture", "prior", "segmentation", "base", "emission", "shading", "second_look"),
            (
                "affines",
                "capture.dynamic_range",
                "components.metallic",
                "materials",
                "prior.kind",
                "seed",
            ),
        ),
        Stage(
            "render",
            "Render every view again with the recovered materials and lights.",
            ("capture", "segmentation", "base", "emission", "shading", "second_look", "affines"),
            ("render", "seed"),
            scores=True,
        ),
        Stage(
            "lamp_images",
            "Render the recovered scene with every lamp by itself; made on demand by relight.",
            ("capture", "segmentation", "base", "emission", "second_look", "affines"),
            ("lamp_images", "seed"),
            reads_raw=True,
            on_demand=True,
        ),
        Stage(
            "relight",
            "Render the recovered scene under other light, edited; made on demand.",
            ("capture", "segmentation", "base", "emission", "second_look", "affines", "lamp_images"),
            ("relight", "relight_title", "names", "seed"),
            reads_raw=True,
            on_demand=True,
        ),
        Stage(
            "metrics",
            "Score the result against ground truth, where there is any, and against the photographs.",
            ("capture", "prior", "segmentation", "base", "emission", "shading", "second_look", "affines", "render"),
            ("metrics",),
            reads_raw=True,
            files=("workflow.models.lpips",),
            scores=True,
        ),
        Stage(
            "unwrap",
            "Clean, simplify and unwrap the mesh for the exported files.",
            ("capture", "segmentation", "base", "emission"),
            ("export.max_faces_glb", "export.texture_size", "names"),
        ),
        Stage(
            "export",
            "Write the result for other programs: glTF, Mitsuba, tables.",
            ("capture", "segmentation", "base", "emission", "second_look", "affines", "unwrap"),
            ("export", "names"),
            reads_raw=True,
            files=("workflow.decisions.held",),
            scores=True,
            threads=1,
        ),
        Stage(
            "room",
            "Write room.html: a page to walk through the room and to switch its lamps.",
            ("capture", "segmentation", "base", "emission", "second_look", "affines", "unwrap"),
            ("room", "report.credit", "export.max_parts", "names", "seed"),
            reads_raw=True,
            files=("workflow.room.sources", "workflow.decisions.held"),
            scores=True,
        ),
        Stage(
            "report",
            "Write report.html, and plan.yaml with all decisions settled.",
            _REPORTED,
            ("report", "names"),
            reads_raw=True,
            files=("workflow.report.sources", "workflow.decisions.held"),
            scores=True,
            threads=1,
            also=(("photographs", ("reconstruction",)),),
        ),
        Stage(
            "publish",
            "Copy the deliverable to scenes/<scene>/.",
            (*_REPORTED, "report", "room"),
            (),
            scores=True,
            threads=1,
        ),
        *(Stage(name, **facts, on_demand=True) for name, facts in plugins.added_stages().items()),
    )
}


def upstream_of(stage: str) -> set[str]:
    """Return all stages from which a stage is made, directly or not."""
    found = set(STAGES[stage].upstream)
    return found.union(*(upstream_of(one) for one in found))
