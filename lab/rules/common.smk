# Functions that choose names, inputs and parameters for the rules of the laboratory.
import sys

from lab.stability.record import code as stability_code_digest
from lab.studies import grid as study_sheet
from lab.studies import table as study_table
from workflow.settings import derived as derived_scenes

KERNEL_BENCHMARKS = "hashgrid|base_cost"
STABILITY_PARTS = (
    "kernels",
    "solvers",
    "sums",
    "relations",
    "digits",
    "samplers",
    "renderings",
    "caches",
    "extremes",
    "sensitivity",
)


wildcard_constraints:
    study=rf"(?!(?:{KERNEL_BENCHMARKS}|stability)\.){derived_scenes.STUDY}",
    benchmark=KERNEL_BENCHMARKS,
    part="|".join(STABILITY_PARTS),


def of_study(compute):
    """`compute(study, quality)` for the study of a target; what is wrong in its file stops here, before any job."""
    return lambda wildcards: product.or_stop(compute, wildcards.study, product.QUALITY)


def study_inputs(study, quality):
    """Manifests of a study; what it will leave out is said before hours of work, not after."""
    for note in study_table.left_out(study, quality):
        print(f"study {study}: {note}", file=sys.stderr)
    return study_table.inputs(study, quality)


def stability_code(wildcards):
    """Digest of everything that the study of stability measures, and measures with."""
    return stability_code_digest()
