rule affines:
    input:
        upstream("affines"),
    output:
        manifest="results/{scene}/affines/manifest.json",
    log:
        "results/{scene}/logs/affines.log",
    benchmark:
        "results/{scene}/benchmarks/affines.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 5000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        job=job("affines"),
        python=sys.executable,
    message:
        "{wildcards.scene}: one affine per object, and the camera response"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"
