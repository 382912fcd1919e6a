# Every scene of config/batch.tsv (docs/batch.md). An input function that raises ends Snakemake's plan for all scenes, so each is
# checked first and a bad one kept out of the plan; one whose job fails does not stop the others. The summary names them, and
# Snakemake ends with an error when the others are done.
import subprocess

from workflow.batch import plan as batch_table

batch_asked = []


def batch_plan():
    """What can be run; a table that cannot be read stops here, before any job."""
    try:
        plan = batch_table.plan(QUALITY)
    except InputError as error:
        stop(error)
    if not batch_asked:
        batch_asked.append(True)
        for reason in plan.refused.values():
            print(f"batch: left out: {reason}", file=sys.stderr)
        # A batch is independent scenes: as --keep-going, for this target without being told.
        workflow.execution_settings.keep_going = True
    return plan


rule batch:
    input:
        lambda wildcards: [f"scenes/{name}" for name in batch_plan().ready],
    output:
        table="results/batch/summary.parquet",
        text="results/batch/summary.tsv",
        page="results/batch/report.html",
        complete="results/batch/complete",
    log:
        "results/batch/summary.log",
    localrule: True
    params:
        mark=lambda wildcards: batch_table.fingerprint(QUALITY),
        quality=QUALITY,
        python=sys.executable,
    message:
        "the batch: table and page"
    shell:
        "{params.python:q} -m workflow batch --quality {params.quality} --fingerprint {params.mark} --log {log:q}"


# Comes last and fails: a batch that left scenes out has not done what it was asked.
rule refused:
    input:
        "results/batch/complete",
    output:
        "results/batch/refused",
    log:
        "results/batch/refused.log",
    retries: 0
    localrule: True
    params:
        quality=QUALITY,
        python=sys.executable,
    message:
        "the batch: what could not be run"
    shell:
        "{params.python:q} -m workflow batch --refused --quality {params.quality} --log {log:q}"


def batch_targets(wildcards):
    """The summary, and every scene by itself lest an old summary stand for one that is gone. Parts (`--batch batch=1/10`) divide
    what the summary reads, so there it stands alone."""
    plan = batch_plan()
    scenes = (
        [] if workflow.dag_settings.batch else [f"scenes/{name}" for name in plan.ready]
    )
    refused = ["results/batch/refused"] if plan.refused else []
    return [*scenes, "results/batch/complete", *refused]


# Jobs failed, so rule `batch` did not run: the summary then tells of what there is. It is not `complete`, so the next run makes it.
onerror:
    if batch_asked:
        subprocess.run(
            [sys.executable, "-m", "workflow", "batch", "--quality", QUALITY],
            check=False,
        )
