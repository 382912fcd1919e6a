import json


def diffusion_prior(wildcards):
    """Whether the scene's prior is a network of gigabytes rather than a formula."""
    document = json.loads(fingerprints.resolved(wildcards.scene, QUALITY))
    return document["prior"]["kind"] in ("rgbx", "marigold")


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
        mem_mb=lambda wildcards, attempt: attempt
        * (12000 if diffusion_prior(wildcards) else 3000),
        runtime=lambda wildcards, attempt: attempt
        * (720 if diffusion_prior(wildcards) else 120),
    params:
        job=job("prior"),
        python=sys.executable,
    message:
        "{wildcards.scene}: K material predictions a photograph"
    shell:
        "{params.python:q} -m workflow {params.job} --threads {threads} --log {log:q}"
