# Intrinsic Image Fusion: photographs, cameras and a mesh -> scenes/<name>/ with materials, lights and camera response.
#   snakemake --cores 2 scenes/kitchen
#   snakemake --cores 2 scenes/kitchen --config quality=standard       or 120s (some 120 seconds), held_out:24 (dB), p07
#   snakemake --cores 2 scenes                                     every scene of config/batch.tsv
# The rules are in workflow/rules/, the computations in iif_core/; docs/development/architecture.md is the map.
from snakemake.utils import min_version

min_version("9.27")


configfile: f"{workflow.current_basedir}/config/config.yaml"


report: "workflow/report/captions/workflow.rst"


include: "workflow/rules/common.smk"
include: "workflow/rules/hooks.smk"


# Read with `--sdm apptainer` alone: the image of envs/Dockerfile, converted by
# `apptainer build envs/iif.sif docker-daemon://iif:latest`.
container: image


include: "workflow/rules/stages.smk"
include: "workflow/rules/deliver.smk"
include: "workflow/rules/batch.smk"


rule scenes:
    """Every scene of config/batch.tsv, and the summary in results/batch/."""
    default_target: True
    input:
        batch_targets,


rule verify:
    """Hash every artefact again and name what differs from its manifest."""
    log:
        "results/verify.log",
    localrule: True
    message:
        "hashing every artefact again"
    shell:
        "rm -f {log:q}; python3 -m workflow verify 2>&1 | tee {log:q}"


# Last, because it stands for whatever no rule above makes.
include: "workflow/rules/unknown.smk"


onstart:
    choose.keep(REQUEST, CHOSEN)
    tell_costs()
    forget_backups()


onsuccess:
    tell_results()


onerror:
    tell_reasons()
