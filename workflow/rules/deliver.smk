# What people open: scenes/<scene>/ and relight/<scene>/, copies of what the stages wrote.


rule publish:
    """Copy the deliverable to scenes/<scene>/."""
    input:
        unpack(publish_inputs),
    output:
        scene=report(
            update(directory("scenes/{scene}")),  # what people put there is carried over
            patterns=["{page}.html"],
            caption="../report/captions/scene.rst",
            category="Scenes",
            subcategory="{scene}",
        ),
    log:
        "results/{scene}/logs/publish.log",
    priority: 100
    localrule: True
    params:
        job=job("publish"),
    message:
        "{wildcards.scene}: publishing scenes/{wildcards.scene}"
    shell:
        "python3 -m workflow {params.job} --log {log:q}"


rule planned:
    """Write what a scene requires, and what is expected of it, to plan/<scene>/, and show it; no stage after `plan` runs."""
    input:
        unpack(plan_inputs),
    output:
        plan=directory("plan/{scene}"),
    log:
        "results/{scene}/logs/planned.log",
    localrule: True
    params:
        quality=quality,
    message:
        "{wildcards.scene}: what it requires, in plan/{wildcards.scene}/plan.yaml"
    shell:
        "python3 -m workflow planned {wildcards.scene} --quality {params.quality} --log {log:q}"


rule relit:
    """Copy the relit pictures of a scene to relight/<scene>/, and again those of its plans that are finished."""
    input:
        unpack(relit_inputs),
    output:
        pictures=report(
            directory("relight/{scene}"),
            patterns=["{picture}.png"],
            caption="../report/captions/relighting.rst",
            category="Relighting",
            subcategory="{scene}",
        ),
    log:
        "results/{scene}/logs/relit.log",
    localrule: True
    params:
        quality=quality,
    message:
        "{wildcards.scene}: pictures in relight/{wildcards.scene}"
    shell:
        "python3 -m workflow relit {wildcards.scene} --quality {params.quality} --log {log:q}"


rule relit_plan:
    """Copy the pictures of a scene under a plan of config/relight/ to relight/<scene>/<plan>/."""
    input:
        unpack(relit_inputs),
    output:
        pictures=report(
            directory("relight/{scene}/{plan}"),
            patterns=["{picture}.png"],
            caption="../report/captions/relighting.rst",
            category="Relighting",
            subcategory="{scene}",
        ),
    log:
        "results/{scene}/logs/relit-{plan}.log",
    localrule: True
    params:
        quality=quality,
    message:
        "{wildcards.scene}: pictures in relight/{wildcards.scene}/{wildcards.plan}"
    shell:
        "python3 -m workflow relit {wildcards.scene} --plan {wildcards.plan} --quality {params.quality} --log {log:q}"


rule bench:
    """Run three measured qualities in this room: what they take on this machine, and what they score."""
    input:
        bench_inputs,
    output:
        page=directory("bench/{scene}"),
    log:
        "results/{scene}/logs/bench.log",
    localrule: True
    params:
        mark=lambda wildcards: or_stop(bench.marks, wildcards.scene),
    message:
        "{wildcards.scene}: three qualities, in bench/{wildcards.scene}/bench.md"
    shell:
        "python3 -m workflow bench {wildcards.scene} --log {log:q}"


# Compares what is there and computes nothing else, so results are no inputs: a parameter changes with them.
rule compare:
    """Put two results side by side: settings, versions, plan, scores, materials by object, pictures."""
    output:
        page=directory("compare/{first},{second}"),
    log:
        "results/studies/logs/compare_{first},{second}.log",
    localrule: True
    params:
        mark=compared,
        quality=QUALITY,
    message:
        "{wildcards.first} next to {wildcards.second}: compare/{wildcards.first},{wildcards.second}/compare.html"
    shell:
        "python3 -m workflow compare {wildcards.first} {wildcards.second} --quality {params.quality} --output {output.page:q}"
        " --log {log:q}"


rule score:
    """Score anyone's maps against a scene with truth: --config maps=<folder>."""
    input:
        unpack(scored_inputs),
    output:
        page=directory("score/{scene}"),
    log:
        "results/studies/logs/score_{scene}.log",
    localrule: True
    params:
        scored=scored,
    message:
        "{wildcards.scene}: maps scored against its truth, score/{wildcards.scene}/score.html"
    shell:
        "python3 -m workflow score {wildcards.scene} {params.scored[folder]:q} --colour {params.scored[colour]:q}"
        " --quality {params.scored[quality]} --output {output.page:q} --log {log:q}"


# Once, with a connection; LPIPS on VGG16 is then part of every score of a study.
rule lpips_vgg:
    """Fetch the weights of VGG16, with which the paper computes LPIPS."""
    output:
        weights="results/weights/lpips_vgg.npz",
    log:
        "results/weights/lpips_vgg.log",
    localrule: True
    message:
        "fetching the weights of VGG16 (download 64 MB, kept 29 MB)"
    shell:
        "python3 -m workflow lpips_vgg --log {log:q}"
