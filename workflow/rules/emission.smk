rule emission:
    input:
        upstream("emission"),
    output:
        manifest="results/{scene}/emission/manifest.json",
    log:
        "results/{scene}/logs/emission.log",
    benchmark:
        "results/{scene}/benchmarks/emission.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 5000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        job=job("emission"),
        python=sys.executable,
    message:
        "{wildcards.scene}: emitters and their radiance"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"
