# A rule for every stage of workflow/registry.py. Each reads the manifests of the stages that the table names, which list their files
# with hashes, and writes its own.

# Stage -> what it needs besides manifests.
MORE = {"prior": parts_of_prior, "relight": relightable}

# Later stages go first, so that the scenes of a batch are finished one after the other, and not all of them stage by stage.
for number, stage in enumerate(STAGES.values()):
    if stage.name == "publish":  # its output is scenes/<scene>/: deliver.smk
        continue

    rule:
        name:
            stage.name
        input:
            unpack(reads(stage.name, MORE.get(stage.name))),
        output:
            manifest=f"results/{{scene}}/{stage.name}/manifest.json",
        log:
            f"results/{{scene}}/logs/{stage.name}.log",
        priority: number
        threads: stage.threads
        resources:
            **needs(stage.name),
        params:
            job=job(stage.name),
        message:
            f"{{wildcards.scene}}: {stage.does}"
        shell:
            "python3 -m workflow {params.job} --threads {threads} --log {log:q}"

    workflow.get_rule(stage.name).docstring = stage.does  # for `--list`; only a literal can be one otherwise


# Only with `--set-scatter prior=8` (docs/guide/batch.md#the-prior-on-several-nodes). Stage prior takes over what the parts have left.
scattergather:
    prior=1,


rule prior_part:
    """Predict the materials of a part of the photographs, for stage prior; made with --set-scatter prior=8."""
    input:
        unpack(reads("prior")),
    output:
        part=temp("results/{scene}/parts/prior.{scatteritem}"),
    log:
        "results/{scene}/logs/prior.{scatteritem}.log",
    threads: 2
    resources:
        **needs("prior"),
    params:
        job=job("prior"),
    message:
        "{wildcards.scene}: Predict materials, part {wildcards.scatteritem}."
    shell:
        "python3 -m workflow {params.job} --threads {threads} --log {log:q} --part {wildcards.scatteritem}"
        " && touch {output.part:q}"
