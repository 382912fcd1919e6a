rule render:
    input:
        upstream("render"),
    output:
        manifest="results/{scene}/render/manifest.json",
    log:
        "results/{scene}/logs/render.log",
    benchmark:
        "results/{scene}/benchmarks/render.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 5000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        job=job("render"),
        python=sys.executable,
    message:
        "{wildcards.scene}: re-rendering every view"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"


rule metrics:
    input:
        upstream("metrics"),
    output:
        manifest="results/{scene}/metrics/manifest.json",
    log:
        "results/{scene}/logs/metrics.log",
    benchmark:
        "results/{scene}/benchmarks/metrics.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        job=job("metrics"),
        python=sys.executable,
    message:
        "{wildcards.scene}: scores"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"


rule export:
    input:
        upstream("export"),
    output:
        manifest="results/{scene}/export/manifest.json",
    log:
        "results/{scene}/logs/export.log",
    benchmark:
        "results/{scene}/benchmarks/export.jsonl"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 5000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        job=job("export"),
        python=sys.executable,
    message:
        "{wildcards.scene}: glTF, Mitsuba scene and maps"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"


rule report:
    input:
        upstream("report"),
    output:
        manifest="results/{scene}/report/manifest.json",
    log:
        "results/{scene}/logs/report.log",
    benchmark:
        "results/{scene}/benchmarks/report.jsonl"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 30 * attempt,
    params:
        job=job("report"),
        python=sys.executable,
    message:
        "{wildcards.scene}: the page"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"


rule publish:
    input:
        upstream("publish"),
    output:
        scene=directory("scenes/{scene}"),
    log:
        "results/{scene}/logs/publish.log",
    localrule: True
    params:
        job=job("publish"),
        python=sys.executable,
    message:
        "{wildcards.scene}: publishing scenes/{wildcards.scene}"
    shell:
        "{params.python:q} -m workflow {params.job} --log {log:q}"


# `scenes/My room`, `scenes/kitchen.yaml`: without this, Snakemake says no more than that no rule makes it.
rule unknown_scene:
    input:
        unknown,
    output:
        directory("scenes/{name}"),
    wildcard_constraints:
        name=rf"(?!{SCENE_NAME}$)[^/]+",
    localrule: True
