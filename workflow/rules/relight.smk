# Pictures of the recovered scene under other light: `relight:` in config/scenes/<scene>.yaml (docs/relighting.md).
rule relight:
    input:
        upstream("relight"),
    output:
        manifest="results/{scene}/relight/manifest.json",
    log:
        "results/{scene}/logs/relight.log",
    benchmark:
        "results/{scene}/benchmarks/relight.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 5000 * attempt,
        runtime=lambda wildcards, attempt: 240 * attempt,
    params:
        job=job("relight"),
        python=sys.executable,
    message:
        "{wildcards.scene}: relighting"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"


# The pictures without the workflow's own files.
rule relit:
    input:
        "results/{scene}/relight/manifest.json",
    output:
        pictures=directory("relight/{scene}"),
    log:
        "results/{scene}/logs/relit.log",
    localrule: True
    message:
        "{wildcards.scene}: pictures in relight/{wildcards.scene}"
    shell:
        "mkdir -p {output.pictures:q} && cp -r results/{wildcards.scene}/relight/. {output.pictures:q}"
        " && rm {output.pictures:q}/manifest.json > {log:q} 2>&1"
