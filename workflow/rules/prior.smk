rule prior:
    input:
        upstream("prior"),
    output:
        manifest="results/{scene}/prior/manifest.json",
    log:
        "results/{scene}/logs/prior.log",
    benchmark:
        "results/{scene}/benchmarks/prior.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        job=job("prior"),
        python=sys.executable,
    message:
        "{wildcards.scene}: K material predictions a photograph"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"
