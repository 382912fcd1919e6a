rule base:
    input:
        upstream("base"),
    output:
        manifest="results/{scene}/base/manifest.json",
    log:
        "results/{scene}/logs/base.log",
    benchmark:
        "results/{scene}/benchmarks/base.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 5000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        job=job("base"),
        python=sys.executable,
    message:
        "{wildcards.scene}: fusing the predictions into one base texture"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"
