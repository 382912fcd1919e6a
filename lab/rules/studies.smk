# Studies: their variants are derived scenes, which the stages make; a study collects their scores (lab/docs/studies.md).


rule study:
    """Collect the scores of a study: table, page and picture in results/studies/."""
    input:
        manifests=of_study(study_inputs),
    output:
        table="results/studies/{study}.parquet",
        page=report(
            "results/studies/{study}.md",
            caption="../captions/study.rst",
            category="Studies",
            subcategory="{study}",
        ),
        picture=report(
            "results/studies/{study}.png",
            caption="../captions/study.rst",
            category="Studies",
            subcategory="{study}",
        ),
    log:
        "results/studies/logs/{study}.log",
    localrule: True
    params:
        mark=of_study(study_table.fingerprint),
        quality=product.QUALITY,
    message:
        "study {wildcards.study}: table and picture"
    shell:
        "python3 -m lab study {wildcards.study} --quality {params.quality} --fingerprint {params.mark} --log {log:q}"


# Shows the variants that are finished and computes nothing else, so a parameter changes with them.
rule study_grid:
    """Draw a sheet of pictures of a study, for a paper: methods next to each other, as PNG and PDF."""
    output:
        picture="results/studies/{study}.grid.png",
        document="results/studies/{study}.grid.pdf",
    log:
        "results/studies/logs/{study}.grid.log",
    localrule: True
    params:
        mark=of_study(study_sheet.mark),
        quality=product.QUALITY,
    message:
        "study {wildcards.study}: sheet of pictures"
    shell:
        "python3 -m lab grid {wildcards.study} --quality {params.quality} --log {log:q}"


rule stability_part:
    """Measure the numerical errors of kernels, solvers or sums."""
    output:
        table="results/studies/stability/{part}.parquet",
    log:
        "results/studies/logs/stability_{part}.log",
    resources:
        mem_mb=6000,
    params:
        mark=stability_code,
    message:
        "stability: {wildcards.part}"
    shell:
        "python3 -m lab stability {wildcards.part} --fingerprint {params.mark} --log {log:q}"


rule stability:
    """Collect the numerical errors of all parts: table and page."""
    input:
        parts=expand("results/studies/stability/{part}.parquet", part=STABILITY_PARTS),
    output:
        table="results/studies/stability.parquet",
        page=report(
            "results/studies/stability.md",
            caption="../captions/stability.rst",
            category="Studies",
            subcategory="stability",
        ),
    log:
        "results/studies/logs/stability.log",
    localrule: True
    params:
        mark=stability_code,
    message:
        "stability: table"
    shell:
        "python3 -m lab stability --fingerprint {params.mark} --log {log:q}"


# Ratios of times within one run, on an idle machine.
rule benchmark:
    """Compare the speed of kernels: results/studies/hashgrid.parquet, base_cost.parquet."""
    output:
        table="results/studies/{benchmark}.parquet",
    log:
        "results/studies/logs/{benchmark}.log",
    threads: 2
    params:
        script=lambda wildcards: f"{product.CHECKOUT}/lab/benchmarks/{wildcards.benchmark}.py",
    message:
        "benchmark {wildcards.benchmark}"
    shell:
        "python3 {params.script:q} --output {output.table:q} 2>&1 | tee {log:q}"
