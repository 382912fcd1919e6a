"""The stages, in one table: what each is for, what it needs and which settings it reads.

`settings` are dotted paths into the settings tree. A stage can see no others (`Job.settings` refuses), so its fingerprint covers
everything that it can depend on. Nothing heavy is imported here, because the Snakefile reads this table.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """One rule of workflow/rules/stages.smk.

    Attributes:
        name: of the stage, its rule, its module in workflow/stages/ and its folder in results/<scene>/.
        purpose: what it does, for `snakemake --list`.
        upstream: stages whose files it reads.
        settings: dotted paths of the settings that it reads.
        reads_raw: whether files from outside results/ enter here.
        on_demand: whether no scene needs it, only a study or a target of its own.
    """

    name: str
    purpose: str
    upstream: tuple[str, ...]
    settings: tuple[str, ...]
    reads_raw: bool = False
    on_demand: bool = False

    @property
    def module(self) -> str:
        return f"workflow.stages.{self.name}"


STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage(
            "capture",
            "Bring photographs, cameras and mesh into the normal form, or render them.",
            (),
            ("source", "capture", "seed"),
            reads_raw=True,
        ),
        Stage(
            "prior", "Predict materials K times for every photograph.", ("capture",), ("prior", "source", "seed"), reads_raw=True
        ),
        Stage(
            "segmentation",
            "Assign faces of the mesh to objects, and pixels to segments.",
            ("capture",),
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
            "base_scores",
            "Score the base texture; made on demand by studies.",
            ("capture", "prior", "segmentation", "base"),
            (),
            reads_raw=True,
            on_demand=True,
        ),
        Stage(
            "emission",
            "Find the emitters and solve for their radiance.",
            ("capture", "segmentation", "base"),
            ("emission", "capture.dynamic_range", "affines.response", "seed"),
            reads_raw=True,
        ),
        Stage(
            "shading",
            "Trace the light that arrives at every pixel, once for all later fits.",
            ("capture", "segmentation", "base", "emission"),
            ("shading", "seed"),
        ),
        Stage(
            "affines",
            "Fit one affine map per object, and the camera response, to the photographs.",
            ("capture", "prior", "segmentation", "base", "emission", "shading"),
            ("affines", "capture.dynamic_range", "emission.saturation", "prior.kind", "seed"),
        ),
        Stage(
            "render",
            "Render every view again with the recovered materials and lights.",
            ("capture", "segmentation", "base", "emission", "affines"),
            ("render", "seed"),
        ),
        Stage(
            "relight",
            "Render the recovered scene under other light; made on demand.",
            ("capture", "segmentation", "base", "emission", "affines"),
            ("relight", "seed"),
            reads_raw=True,
            on_demand=True,
        ),
        Stage(
            "metrics",
            "Score the result against ground truth, where there is any, and against the photographs.",
            ("capture", "prior", "segmentation", "base", "emission", "shading", "affines", "render"),
            ("metrics",),
            reads_raw=True,
        ),
        Stage(
            "export",
            "Write the result for other programs: glTF, Mitsuba, tables.",
            ("capture", "segmentation", "base", "emission", "affines"),
            ("export",),
        ),
        Stage(
            "report",
            "Write report.html and plan.yaml.",
            ("capture", "prior", "segmentation", "base", "emission", "shading", "affines", "render", "metrics", "export"),
            ("report",),
        ),
        Stage(
            "publish",
            "Copy the deliverable to scenes/<scene>/.",
            (
                "capture",
                "prior",
                "segmentation",
                "base",
                "emission",
                "shading",
                "affines",
                "render",
                "metrics",
                "export",
                "report",
            ),
            (),
        ),
    )
}
