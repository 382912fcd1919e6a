rule capture:
    input:
        upstream("capture"),
    output:
        manifest="results/{scene}/capture/manifest.json",
    log:
        "results/{scene}/logs/capture.log",
    benchmark:
        "results/{scene}/benchmarks/capture.jsonl"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 5000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        job=job("capture"),
        python=sys.executable,
    message:
        "{wildcards.scene}: photographs, cameras and mesh into the normal form"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"
