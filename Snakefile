# Intrinsic Image Fusion: photographs, cameras and a mesh -> scenes/<name>/ with materials, lights and camera response.
#   snakemake --cores 2 scenes/kitchen
#   snakemake --cores 2 scenes/kitchen --config quality=standard
#   snakemake --cores 2 scenes                                     every scene of config/batch.tsv
# What depends on what is in workflow/rules/, what is computed in iif_core/. docs/architecture.md is the map.
from snakemake.utils import min_version

min_version("9.0")


configfile: f"{workflow.basedir}/config/config.yaml"


include: "workflow/rules/common.smk"
include: "workflow/rules/capture.smk"
include: "workflow/rules/prior.smk"
include: "workflow/rules/segmentation.smk"
include: "workflow/rules/base.smk"
include: "workflow/rules/emission.smk"
include: "workflow/rules/shading.smk"
include: "workflow/rules/affines.smk"
include: "workflow/rules/deliver.smk"
include: "workflow/rules/relight.smk"
include: "workflow/rules/studies.smk"
include: "workflow/rules/batch.smk"


localrules:
    scenes,
    verify,


rule scenes:
    default_target: True
    input:
        batch_targets,


rule verify:
    log:
        "results/verify.log",
    params:
        python=sys.executable,
    message:
        "re-hashing every artefact"
    shell:
        "{params.python:q} -m workflow verify 2>&1 | tee {log:q}"
