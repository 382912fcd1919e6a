# The stages, in order. Each reads the manifests of the stages named as its inputs, which lists their files with hashes, and
# writes its own. What a stage may read, and which settings, is in workflow/registry.py.


pathvars:
    stage="stage",


rule stage:
    """Template of the stages below; not run itself."""
    input:
        no_stage,
    output:
        manifest="results/{scene}/<stage>/manifest.json",
    log:
        "results/{scene}/logs/<stage>.log",
    benchmark:
        "results/{scene}/benchmarks/<stage>.jsonl"
    threads: 2
    shell:
        "python3 -m workflow {params.job} --threads {threads} --log {log:q}"


use rule stage as capture with:
    input:
        unpack(reads("capture")),
    pathvars:
        stage="capture",
    resources:
        **needs("capture"),
    params:
        job=job("capture"),
    message:
        "{wildcards.scene}: photographs, cameras and mesh into the normal form"


use rule stage as plan with:
    input:
        unpack(reads("plan", "capture")),
    pathvars:
        stage="plan",
    resources:
        **needs("plan"),
    params:
        job=job("plan"),
    message:
        "{wildcards.scene}: what the scene requires"


use rule stage as prior with:
    input:
        unpack(with_parts(reads("prior", "capture"))),
    pathvars:
        stage="prior",
    resources:
        **needs("prior"),
    params:
        job=job("prior"),
    message:
        "{wildcards.scene}: K material predictions for every photograph"


# Only with `--set-scatter prior=8` (docs/guide/batch.md#the-prior-on-several-nodes). Stage prior takes over what the parts have left.
scattergather:
    prior=1,


rule prior_part:
    """Predict the materials of a part of the photographs, for stage prior; made with --set-scatter prior=8."""
    input:
        unpack(reads("prior", "capture")),
    output:
        part=temp("results/{scene}/parts/prior.{scatteritem}"),
    log:
        "results/{scene}/logs/prior.{scatteritem}.log",
    threads: 2
    resources:
        **needs("prior"),
    params:
        job=job("prior"),
    message:
        "{wildcards.scene}: K material predictions, part {wildcards.scatteritem}"
    shell:
        "python3 -m workflow {params.job} --threads {threads} --log {log:q} --part {wildcards.scatteritem}"
        " && touch {output.part:q}"


use rule stage as segmentation with:
    input:
        unpack(reads("segmentation", "capture", "prior")),
    pathvars:
        stage="segmentation",
    resources:
        **needs("segmentation"),
    params:
        job=job("segmentation"),
    message:
        "{wildcards.scene}: faces to objects, pixels to segments"


use rule stage as base with:
    input:
        unpack(reads("base", "capture", "prior", "segmentation")),
    pathvars:
        stage="base",
    resources:
        **needs("base"),
    params:
        job=job("base"),
    message:
        "{wildcards.scene}: fusing the predictions into one base texture"


use rule stage as emission with:
    input:
        unpack(reads("emission", "capture", "plan", "segmentation", "base")),
    pathvars:
        stage="emission",
    resources:
        **needs("emission"),
    params:
        job=job("emission"),
    message:
        "{wildcards.scene}: emitters and their radiance"


use rule stage as shading with:
    input:
        unpack(reads("shading", "capture", "plan", "segmentation", "base", "emission")),
    pathvars:
        stage="shading",
    resources:
        **needs("shading"),
    params:
        job=job("shading"),
    message:
        "{wildcards.scene}: cached incident shading"


use rule stage as second_look with:
    input:
        unpack(reads("second_look", "capture", "prior", "segmentation", "shading")),
    pathvars:
        stage="second_look",
    resources:
        **needs("second_look"),
    params:
        job=job("second_look"),
    message:
        "{wildcards.scene}: predicting and fusing once more, under the light that was found"


use rule stage as affines with:
    input:
        unpack(
            reads(
                "affines",
                "capture",
                "prior",
                "segmentation",
                "base",
                "emission",
                "shading",
                "second_look",
            )
        ),
    pathvars:
        stage="affines",
    resources:
        **needs("affines"),
    params:
        job=job("affines"),
    message:
        "{wildcards.scene}: one affine map per object, and the camera response"


use rule stage as render with:
    input:
        unpack(
            reads(
                "render",
                "capture",
                "segmentation",
                "base",
                "emission",
                "shading",
                "second_look",
                "affines",
            )
        ),
    pathvars:
        stage="render",
    resources:
        **needs("render"),
    params:
        job=job("render"),
    message:
        "{wildcards.scene}: re-rendering every view"


use rule stage as metrics with:
    input:
        unpack(
            reads(
                "metrics",
                "capture",
                "prior",
                "segmentation",
                "base",
                "emission",
                "shading",
                "second_look",
                "affines",
                "render",
            )
        ),
    pathvars:
        stage="metrics",
    resources:
        **needs("metrics"),
    params:
        job=job("metrics"),
    message:
        "{wildcards.scene}: scores"


use rule stage as unwrap with:
    input:
        unpack(reads("unwrap", "capture", "segmentation", "base", "emission")),
    pathvars:
        stage="unwrap",
    resources:
        **needs("unwrap"),
    params:
        job=job("unwrap"),
    message:
        "{wildcards.scene}: the mesh in parts, with texture coordinates"


use rule stage as export with:
    input:
        unpack(
            reads(
                "export",
                "capture",
                "segmentation",
                "base",
                "emission",
                "second_look",
                "affines",
                "unwrap",
            )
        ),
    pathvars:
        stage="export",
    threads: 1
    resources:
        **needs("export"),
    params:
        job=job("export"),
    message:
        "{wildcards.scene}: glTF, Mitsuba scene and tables"


use rule stage as room with:
    input:
        unpack(
            reads(
                "room",
                "capture",
                "segmentation",
                "base",
                "emission",
                "second_look",
                "affines",
                "unwrap",
            )
        ),
    pathvars:
        stage="room",
    resources:
        **needs("room"),
    params:
        job=job("room"),
    message:
        "{wildcards.scene}: light of every lamp, and the page to walk in"


use rule stage as report with:
    input:
        unpack(
            reads(
                "report",
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
        ),
    pathvars:
        stage="report",
    threads: 1
    resources:
        **needs("report"),
    params:
        job=job("report"),
    message:
        "{wildcards.scene}: the page"


# On demand: `relight:` in config/scenes/<scene>.yaml, or a plan of config/relight/ (docs/guide/relighting.md).
use rule stage as lamp_images with:
    input:
        unpack(
            reads(
                "lamp_images",
                "capture",
                "segmentation",
                "base",
                "emission",
                "second_look",
                "affines",
            )
        ),
    pathvars:
        stage="lamp_images",
    resources:
        **needs("lamp_images"),
    params:
        job=job("lamp_images"),
    message:
        "{wildcards.scene}: the light of every lamp by itself"


use rule stage as relight with:
    input:
        unpack(
            relight_inputs(
                "capture",
                "segmentation",
                "base",
                "emission",
                "second_look",
                "affines",
                "lamp_images",
            )
        ),
    pathvars:
        stage="relight",
    resources:
        **needs("relight"),
    params:
        job=job("relight"),
    message:
        "{wildcards.scene}: relighting"


# On demand: studies whose scores are those of the base texture.
use rule stage as base_scores with:
    input:
        unpack(reads("base_scores", "capture", "prior", "segmentation", "base")),
    pathvars:
        stage="base_scores",
    resources:
        **needs("base_scores"),
    params:
        job=job("base_scores"),
    message:
        "{wildcards.scene}: scores of the base texture"


# On demand: studies whose variants have other photographs.
use rule stage as common_scores with:
    input:
        unpack(
            reads(
                "common_scores",
                "capture",
                "segmentation",
                "base",
                "emission",
                "second_look",
                "affines",
                "shared_capture",
                "shared_segmentation",
            )
        ),
    pathvars:
        stage="common_scores",
    resources:
        **needs("common_scores"),
    params:
        job=job("common_scores"),
    message:
        "{wildcards.scene}: scores at shared views"


# Shown by `snakemake --list`: snakefmt knows no docstrings in `use rule`.
descriptions = {
    "capture": "Bring photographs, cameras and mesh into the normal form, or render them.",
    "plan": "Find out, from photographs and mesh alone, which parts of the model the scene requires.",
    "prior": "Predict materials K times for every photograph.",
    "segmentation": "Assign faces of the mesh to objects, and pixels to segments.",
    "base": "Fuse the predictions of all views into one base texture.",
    "emission": "Find the emitters and solve for their radiance.",
    "shading": "Trace the light that arrives at every pixel, once for all later fits.",
    "second_look": "Predict and fuse once more, under the light that was found.",
    "affines": "Fit one affine map per object, and the camera response, to the photographs.",
    "render": "Render every view again with the recovered materials and lights.",
    "metrics": "Score the result against ground truth, where there is any, and against the photographs.",
    "unwrap": "Clean, simplify and unwrap the mesh for the exported files.",
    "export": "Write the result for other programs: glTF, Mitsuba, tables.",
    "room": "Write room.html: a page to walk through the room and to switch its lamps.",
    "report": "Write report.html, and plan.yaml with all decisions settled.",
    "lamp_images": "Render the recovered scene with every lamp by itself; made on demand by relight.",
    "relight": "Render the recovered scene under other light, edited; made on demand.",
    "base_scores": "Score the base texture; made on demand by studies.",
    "common_scores": "Score the result at views that all variants of a study share; made on demand by studies.",
}
# Later stages go first, so that the scenes of a batch are finished one after the other, and not all of them stage by stage.
for number, (name, text) in enumerate(descriptions.items()):
    workflow.get_rule(name).docstring = text
    workflow.get_rule(name).priority = number
