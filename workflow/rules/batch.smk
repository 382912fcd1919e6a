# Every scene of config/batch.tsv (docs/guide/batch.md).


rule batch:
    """Write the table and the page of the batch to results/batch/."""
    input:
        scenes=lambda wildcards: [f"scenes/{name}" for name in batch_plan().ready],
    output:
        table="results/batch/summary.parquet",
        text="results/batch/summary.tsv",
        page=report(
            "results/batch/report.html",
            caption="../report/captions/batch.rst",
            category="Batch",
        ),
        complete="results/batch/complete",
    log:
        "results/batch/summary.log",
    localrule: True
    params:
        mark=lambda wildcards: batch_table.fingerprint(QUALITY),
        quality=QUALITY,
    message:
        "the batch: table and page"
    shell:
        "python3 -m workflow batch --quality {params.quality} --fingerprint {params.mark} --log {log:q}"


# Comes last and fails: a batch that left scenes out has not done what it was asked.
rule refused:
    """Name the scenes of the batch that cannot be run, and fail."""
    input:
        complete="results/batch/complete",
    output:
        "results/batch/refused",
    log:
        "results/batch/refused.log",
    retries: 0
    localrule: True
    params:
        quality=QUALITY,
    message:
        "the batch: what could not be run"
    shell:
        "python3 -m workflow batch --refused --quality {params.quality} --log {log:q}"
