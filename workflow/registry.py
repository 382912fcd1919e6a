"""The stages, in one table: what each needs and which settings it reads.

`settings` are dotted paths into the settings tree. A stage can see no others (`Job.settings` refuses), so its fingerprint covers
everything that it can depend on.
"""

from __future__ import annotations

from dataclasses import dataclass

from workflow import plugins


@dataclass(frozen=True)
class Stage:
    """One rule of workflow/rules/stages.smk.

    Attributes:
        name: of the stage, its rule, its module in workflow/stages/ and its folder in results/<scene>/.
        upstream: stages whose files it reads.
        settings: dotted paths of the settings that it reads.
        reads_raw: whether files from outside results/ enter here.
        on_demand: whether no scene needs it, only a study or its own target.
        shared: stages whose files it reads in the folder of the scene that all variants of a study share.
        files: modules whose `raw_inputs` know (and check) further input files.
        place: name of its module where that is not `workflow.stages.<name>`.
    """

    name: str
    upstream: tuple[str, ...]
    settings: tuple[str, ...]
    reads_raw: bool = False
    on_demand: bool = False
    shared: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    place: str = ""

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
        Stage("capture", (), ("source", "capture", "seed"), reads_raw=True),
        Stage(
            "plan",
            ("capture",),
            (
                "override.components.specular",
                "emission.environment",
                "emission.saturation",
                "segmentation.kind",
                "seed",
            ),
        ),
        Stage("prior", ("capture",), ("prior", "source", "segmentation.kind", "seed"), reads_raw=True),
        Stage("segmentation", ("capture", "prior"), ("segmentation", "source", "capture"), reads_raw=True),
        Stage("base", ("capture", "prior", "segmentation"), ("base", "seed")),
        Stage("base_scores", ("capture", "prior", "segmentation", "base"), (), reads_raw=True, on_demand=True),
        Stage(
            "emission",
            ("capture", "plan", "segmentation", "base"),
            ("emission", "capture.dynamic_range", "affines.response", "seed"),
            reads_raw=True,
            files=("workflow.scene.response_file",),
        ),
        Stage("shading", ("capture", "plan", "segmentation", "base", "emission"), ("shading", "seed")),
        Stage(
            "second_look",
            ("capture", "prior", "segmentation", "shading"),
            ("second_look", "prior", "segmentation.kind", "base", "seed"),
        ),
        Stage(
            "affines",
            ("capture", "prior", "segmentation", "base", "emission", "shading", "second_look"),
            (
                "affines",
                "capture.dynamic_range",
                "emission.saturation",
                "override.components.metallic",
                "overrides",
                "prior.kind",
                "seed",
            ),
        ),
        Stage("render", ("capture", "segmentation", "base", "emission", "shading", "second_look", "affines"), ("render", "seed")),
        Stage(
            "lamp_images",
            ("capture", "segmentation", "base", "emission", "second_look", "affines"),
            ("lamp_images", "seed"),
            reads_raw=True,
            on_demand=True,
        ),
        Stage(
            "relight",
            ("capture", "segmentation", "base", "emission", "second_look", "affines", "lamp_images"),
            ("relight", "relight_title", "seed"),
            reads_raw=True,
            on_demand=True,
        ),
        Stage(
            "metrics",
            ("capture", "prior", "segmentation", "base", "emission", "shading", "second_look", "affines", "render"),
            ("metrics",),
            reads_raw=True,
        ),
        Stage(
            "common_scores",
            ("capture", "segmentation", "base", "emission", "second_look", "affines"),
            ("seed",),
            on_demand=True,
            shared=("capture", "segmentation"),
        ),
        Stage("unwrap", ("capture", "segmentation", "base", "emission"), ("export.max_faces_glb", "export.texture_size")),
        Stage("export", ("capture", "segmentation", "base", "emission", "second_look", "affines", "unwrap"), ("export",)),
        Stage(
            "room",
            ("capture", "segmentation", "base", "emission", "second_look", "affines", "unwrap"),
            ("room", "report.credit", "seed"),
            reads_raw=True,
            files=("workflow.room.sources",),
        ),
        Stage(
            "report",
            _REPORTED,
            ("report",),
            reads_raw=True,
            files=("workflow.report.sources",),
        ),
        Stage(
            "publish",
            (*_REPORTED, "report", "room"),
            (),
        ),
        *(Stage(name, **facts, on_demand=True) for name, facts in plugins.added_stages().items()),
    )
}


def upstream_of(stage: str) -> set[str]:
    """Return all stages from which a stage is made, directly or not."""
    found = set(STAGES[stage].upstream)
    return found.union(*(upstream_of(one) for one in found))
