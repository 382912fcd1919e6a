# Studies: variants are derived scenes that the ordinary rules make (workflow/studies/files.py); a study collects their scores.
from workflow.settings import study_files
from workflow.studies import table as study_table

BENCHMARKS = "hashgrid|base_cost"


wildcard_constraints:
    study=rf"(?!(?:{BENCHMARKS})\.){study_files.STUDY}",
    benchmark=BENCHMARKS,


def of_study(compute):
    """Call `compute(study, QUALITY)` for a rule; what is wrong in its file stops here, before any job."""

    def value(wildcards):
        try:
            return compute(wildcards.study, QUALITY)
        except InputError as error:
            stop(error)

    return value


rule base_scores:
    input:
        upstream("base_scores"),
    output:
        manifest="results/{scene}/base_scores/manifest.json",
    log:
        "results/{scene}/logs/base_scores.log",
    benchmark:
        "results/{scene}/benchmarks/base_scores.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        job=job("base_scores"),
        python=sys.executable,
    message:
        "{wildcards.scene}: scores of the base texture"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"


def study_inputs(study, quality):
    """Manifests of a study; what it will leave out is said before hours of work, not after."""
    for note in study_table.left_out(study, quality):
        print(f"study {study}: {note}", file=sys.stderr)
    return study_table.inputs(study, quality)


rule study:
    input:
        of_study(study_inputs),
    output:
        table="results/studies/{study}.parquet",
        page="results/studies/{study}.md",
        picture="results/studies/{study}.png",
    log:
        "results/studies/logs/{study}.log",
    localrule: True
    params:
        mark=of_study(study_table.fingerprint),
        quality=QUALITY,
        python=sys.executable,
    message:
        "study {wildcards.study}: table and picture"
    shell:
        "{params.python:q} -m workflow study {wildcards.study} --quality {params.quality} --fingerprint {params.mark} --log {log:q}"


# Once, with a connection; LPIPS with VGG16 is then part of every score of a study.
rule lpips_vgg:
    output:
        "results/weights/lpips_vgg.npz",
    log:
        "results/weights/lpips_vgg.log",
    localrule: True
    params:
        python=sys.executable,
    message:
        "fetching the weights of VGG16 (download 64 MB, kept 29 MB)"
    shell:
        "{params.python:q} -m workflow lpips_vgg --log {log:q}"


# Benchmarks of kernels: ratios within one run, on an idle machine.
rule benchmark:
    output:
        "results/studies/{benchmark}.parquet",
    log:
        "results/studies/logs/{benchmark}.log",
    threads: 2
    params:
        script=lambda wildcards: f"{workflow.basedir}/tests/benchmarks/{wildcards.benchmark}.py",
        python=sys.executable,
    message:
        "benchmark {wildcards.benchmark}"
    shell:
        "{params.python:q} {params.script:q} --output {output:q} 2>&1 | tee {log:q}"
