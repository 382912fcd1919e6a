rule shading:
    input:
        upstream("shading"),
    output:
        manifest="results/{scene}/shading/manifest.json",
    log:
        "results/{scene}/logs/shading.log",
    benchmark:
        "results/{scene}/benchmarks/shading.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 5000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        job=job("shading"),
        python=sys.executable,
    message:
        "{wildcards.scene}: cached incident shading"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"
