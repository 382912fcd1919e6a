rule segmentation:
    input:
        upstream("segmentation"),
    output:
        manifest="results/{scene}/segmentation/manifest.json",
    log:
        "results/{scene}/logs/segmentation.log",
    benchmark:
        "results/{scene}/benchmarks/segmentation.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        job=job("segmentation"),
        python=sys.executable,
    message:
        "{wildcards.scene}: faces to objects, pixels to segments"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"
