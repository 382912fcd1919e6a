# Functions that choose names, inputs and parameters for the rules.
import json
import os
import re
import sys
import time
from pathlib import Path

# The folder of this workflow, also where another Snakefile takes it as a module; jobs that Snakemake starts elsewhere need it too.
CHECKOUT = str(Path(workflow.current_basedir).parents[1])
sys.path.insert(0, CHECKOUT)

from snakemake.cli import get_argument_parser

from iif_core.errors import InputError
from workflow.artifacts import links, sound
from workflow.batch import causes
from workflow.batch import plan as batch_table
from workflow.comparison import named as comparison
from workflow.registry import SHARED, STAGES
from workflow.relighting import copies
from workflow.relighting.check import check_relightings
from workflow.runtime import fingerprint as fingerprints
from workflow.runtime import forecast, native
from workflow.runtime.job_state import written_out
from workflow.settings import SCENE_NAME, refuse_profile, refuse_target, scene_file
from workflow.settings import derived as derived_scenes
from workflow.settings import prior as prior_settings
from workflow.settings.names import did_you_mean_path
from workflow.trade import bench, choose

STARTED = time.time()
FOLDER = os.getcwd()

native.process_environment()


def stop(message):
    """End with one message for the user instead of a traceback through Snakemake."""
    print(f"\nerror: {message}\n", file=sys.stderr)
    sys.exit(1)


def or_stop(compute, *arguments):
    """What `compute` returns; what is wrong with the user's files ends the run here, before any job."""
    try:
        return compute(*arguments)
    except InputError as error:
        stop(error)


for place in (".", "results", "scenes", ".snakemake"):
    if os.path.exists(place) and not os.access(place, os.W_OK):
        stop(
            f"{os.path.realpath(place)}: not writable for you; results and records are written there."
            " Give yourself the right, or work in a copy of the checkout."
        )


def profile_or_stop():
    """Refuse a workflow profile that is not there. Snakemake read it in the folder where it was called, and with `--directory` it is
    in another one now, and does not say which that was; the shell does."""
    given = get_argument_parser().parse_args()
    start = os.environ.get("PWD", FOLDER) if given.directory else FOLDER
    or_stop(refuse_profile, given.workflow_profile, Path(start), Path(CHECKOUT))


# Only where there is something to check: Snakemake takes half a second to read its arguments.
if workflow.is_main_process and any(word.startswith("--workflow-p") for word in sys.argv):
    profile_or_stop()

# `--config quality=...`: a quality by name, or for each scene the one that a number of seconds or a score asks for.
REQUEST = or_stop(choose.read, config, workflow.resource_settings.cores)
QUALITY = REQUEST.quality  # of batches and comparisons
CHOSEN = {}


def quality_of(scene):
    """The quality of a scene; it is chosen once in a run."""
    if scene not in CHOSEN:
        CHOSEN[scene] = or_stop(choose.choice, REQUEST, scene)
    return CHOSEN[scene].quality


def quality(wildcards):
    return quality_of(wildcards.scene)


def image(wildcards):
    """The image that jobs run in; none without `--sdm apptainer`, because Snakemake refuses an image with a space in its path
    even where it does not read it."""
    if "apptainer" not in map(str, workflow.deployment_settings.deployment_method):
        return None
    path = f"{CHECKOUT}/envs/iif.sif"
    if " " in path:
        stop(
            f"{path}: Snakemake does not read an image with a space in its path. Move the checkout to a folder without spaces,"
            " or leave out `--sdm apptainer`."
        )
    return path


wildcard_constraints:
    scene=SCENE_NAME,
    first=SCENE_NAME,
    second=SCENE_NAME,
    plan=SCENE_NAME,


# ---------------------------------------------------------------------------------------------------------- stages


def reads(stage, more=None):
    """Named inputs of a stage: the manifests of the stages that workflow/registry.py names for it, and what `more` returns for the
    scene.

    The scene is checked first, so that bad input stops before any job. Variants of a study share what they have in common, and
    what is read from the scene that they share has `shared_` before its name.
    """

    def inputs(wildcards):
        scene = wildcards.scene
        target = f"results/{scene}/{stage}/manifest.json" if stage != "publish" else f"scenes/{scene}"
        faults = or_stop(batch_table.check_stage, stage, scene, quality_of(scene))
        again_if_unsound(target, f"{scene}: stage {stage} is made again", faults)
        common, one = derived_scenes.shared_scene(scene), STAGES[stage]
        found = {name: manifest(name, scene) for name in one.reads(resolved(scene))}
        found |= {f"{SHARED}{name}": manifest(name, common) for name in one.shared}
        return found | (more(scene) if more else {})

    return inputs


def manifest(stage, scene):
    """Manifest of a stage, in the folder of the scene that computes it."""
    home = fingerprints.home(stage, scene, quality_of(scene))
    return f"results/{home}/{stage}/manifest.json"


def parts_of_prior(scene):
    """Marks of the parts into which the prior of a scene is scattered (`--set-scatter prior=8`); none by default.

    A finished prior keeps the inputs that it was made from, so that it is not made again because it is asked for in more parts, in
    fewer, or in none: Snakemake compares the names of inputs.
    """
    output = workflow.get_rule("prior").output.manifest
    name = output.apply_wildcards({"scene": scene})  # of Snakemake's own type
    mark = or_stop(fingerprints.fingerprint, "prior", scene, quality_of(scene))
    made = os.path.isfile(name) and "prior" not in workflow.dag_settings.forcerun
    if made and not or_stop(sound.stage_faults, Path("results"), scene, "prior", mark):
        before = workflow.persistence.input(name) or []
        parts = [path for path in before if path.startswith(f"results/{scene}/parts/")]
        return {"parts": parts} if parts else {}
    parts = gather.prior("results/{scene}/parts/prior.{scatteritem}", scene=scene)
    if len(parts) < 2:
        return {}
    groups, kind, why = workflow.group_settings.overwrite_groups, resolved(scene)["prior"]["kind"], ""
    if not prior_settings.by_view(kind):
        why = f"prior {kind} first gathers the light of all photographs, and every part would do that again"
    elif groups.get("prior") != groups.get("prior_part"):
        why = "in this profile the stages of a scene are one job; use workflow/profiles/slurm"
    if why and workflow.is_main_process:
        print(f"{scene}: --set-scatter prior has no effect: {why}", file=sys.stderr)
    return {} if why else {"parts": parts}


def relightable(scene):
    """Nothing; a scene without relightings, or one of which something does not exist, stops here, before any job."""
    or_stop(check_relightings, resolved(scene), scene, quality_of(scene))
    return {}


def job(stage):
    """Arguments of `python3 -m workflow` for a stage; the fingerprint makes Snakemake run again what changed, and only that.

    It must be a function of the wildcards alone: Snakemake does not compare parameters that depend on inputs or outputs.
    """

    def arguments(wildcards):
        scene, quality = wildcards.scene, quality_of(wildcards.scene)
        mark = or_stop(fingerprints.fingerprint, stage, scene, quality)
        return f"{stage} {scene} --quality {quality} --fingerprint {mark}"

    return arguments


def needs(stage):
    """Memory, time and disk that a job of a stage asks for, by the cost model; memory and time grow with every retry."""
    plugin = workflow.executor_plugin
    on_nodes = plugin is not None and plugin.common_settings.non_local_exec

    def value(of, grows):
        def resource(wildcards, threads, attempt):
            scene, quality = wildcards.scene, quality_of(wildcards.scene)
            cost = or_stop(forecast.job_cost, stage, scene, quality, threads)
            return of(cost) * (attempt if grows else 1)

        return resource

    return {
        "mem_mb": value(lambda cost: forecast.memory_mb(cost, on_nodes), True),
        "runtime": value(forecast.minutes, True),
        "disk_mb": value(forecast.disk_mb, False),
    }


def resolved(scene):
    """All settings of a scene, as plain values."""
    return json.loads(or_stop(fingerprints.resolved, scene, quality_of(scene)))


# ----------------------------------------------------------------------------------------------------- deliverables


def again(target):
    """Have the job run that makes `target`, although its inputs are what they were."""
    workflow.dag.forcefiles.add(target)


def again_if_unsound(target, words, faults):
    """Have the job run that makes `target`, if what is there is not what was written, and say once why."""
    if faults and workflow.is_main_process and target not in workflow.dag.forcefiles:
        if text := sound.told(faults, words):
            print(written_out(text), file=sys.stderr)
        again(target)


def folder_or_stop(folder, *files):
    """Refuse a file in the place of a folder, which Snakemake would take for the finished folder. If the folder lacks one of
    `files`, it is made again."""
    or_stop(links.check_folder, folder)
    if os.path.isdir(folder) and not all(os.path.isfile(f"{folder}/{name}") for name in files):
        again(folder)


def publish_inputs(wildcards):
    """What is published. A deliverable is published again if one of its files is missing, or if it is not the one that is wanted."""
    scene, folder = wildcards.scene, f"scenes/{wildcards.scene}"
    folder_or_stop(folder)
    if workflow.is_main_process:
        or_stop(choose.refuse_cheaper, scene, quality_of(scene), config)
    mark = or_stop(fingerprints.fingerprint, "publish", scene, quality_of(scene))
    faults = or_stop(sound.deliverable_faults, Path(folder), Path("results"), scene, mark)
    again_if_unsound(folder, f"{folder} is published again", faults)
    return reads("publish")(wildcards)


def relit_inputs(wildcards):
    """The relightings of a scene, or one plan of them; those with a missing picture are copied again."""
    scene, plan = wildcards.scene, wildcards.get("plan", "")
    folder = f"relight/{scene}/{plan}" if plan else f"relight/{scene}"
    targets = [Path(name).parts for name in workflow.dag_settings.targets]
    if len({len(parts) for parts in targets if parts[:2] == ("relight", scene)}) > 1:
        stop(
            f"relight/{scene}: Snakemake makes a folder and what lies in it only one after the other. Ask twice: first for"
            f" `relight/{scene}`, then for the plans in it."
        )
    folder_or_stop(folder, "contact_sheet.png")  # without it, the folder holds plans alone
    source = or_stop(copies.source, scene, plan, quality_of(scene))
    faults = or_stop(sound.copy_faults, Path(folder), Path("results"), source, "relight")
    again_if_unsound(folder, f"{folder} is copied again", faults)
    return {"manifest": f"results/{source}/relight/manifest.json"}


def plan_inputs(wildcards):
    """The plan of a scene; if it is missing from plan/<scene>/, it is written there again."""
    folder_or_stop(f"plan/{wildcards.scene}", "plan.yaml")
    return {"manifest": manifest("plan", wildcards.scene)}


def bench_inputs(wildcards):
    """Scores of the three qualities that are run in this room; a bench with a missing file is written again."""
    folder_or_stop(f"bench/{wildcards.scene}", "bench.json", "bench.md")
    return [manifest("metrics", one) for one in bench.scenes(wildcards.scene).values()]


def compared(wildcards):
    """Digest of the two results of a comparison; one that is not there stops here, before any job."""
    folder_or_stop(f"compare/{wildcards.first},{wildcards.second}")
    names = wildcards.first, wildcards.second
    for name in names:
        if "--" not in name and not os.path.isdir(f"results/{name}"):
            or_stop(scene_file, name)
    return or_stop(comparison.mark, *names, QUALITY)


def scored_inputs(wildcards):
    """What maps are scored against; without maps the run stops here, before any job."""
    folder_or_stop(f"score/{wildcards.scene}")
    folder = str(config.get("maps", ""))
    holds = "the folder that holds albedo/<view>.exr or .png, roughness/, metallic/ and so on (docs/guide/comparing.md)"
    if not folder:
        stop(f"score/{wildcards.scene}: whose maps? Add --config maps=<folder> with {holds}")
    if not os.path.isdir(folder):
        hint = did_you_mean_path(Path(folder))
        stop(f"--config maps={folder}: no such folder; a relative path counts from {os.getcwd()}.{hint} Give {holds}")
    return {name: manifest(name, wildcards.scene) for name in ("capture", "segmentation")}


def scored(wildcards):
    """Arguments of the command that scores maps, and a digest of them, which Snakemake compares."""
    folder, colour = str(config["maps"]), str(config.get("colour", "auto"))
    mark = or_stop(comparison.digest_of_maps, Path(folder), colour)
    return {"folder": folder, "colour": colour, "quality": quality(wildcards), "mark": mark}


# ---------------------------------------------------------------------------------------------------------- targets


def made_by_no_rule():
    """Pattern of every path that no rule makes that was read so far."""
    patterns = [output.regex().pattern for rule in workflow.rules for output in rule.output]
    unnamed = (re.sub(r"\(\?P<\w+>", "(?:", pattern) for pattern in patterns)
    return "(?!" + "|".join(f"(?:{pattern})" for pattern in unnamed) + ").+"


def unknown(wildcards):
    """Ends with what is wrong about a target that no rule makes, or about a name that no scene can have."""
    folder, _, name = wildcards.target.partition("/")
    if folder == "scenes" and "/" not in name:
        or_stop(scene_file, name)
    rules = [rule.name for rule in workflow.rules if rule.name != "unknown_target"]
    or_stop(refuse_target, wildcards.target, rules)


# ------------------------------------------------------------------------------------------------------------ batch
# An input function that raises ends Snakemake's plan for all scenes, so each scene is checked first and a bad one is kept
# out of the plan. A scene whose job fails does not stop the others. Snakemake ends with an error when the others are done.

batch_asked = []


def batch_plan():
    """What can be run; a table that cannot be read stops here, before any job."""
    if REQUEST.chooses:
        stop(
            f"--config quality={REQUEST.value}: a number of seconds or a score is for scenes that are named, such as"
            " scenes/kitchen; a batch has one quality, so that its scenes can be compared. Name one"
        )
    plan = or_stop(batch_table.plan, QUALITY)
    if not batch_asked:
        batch_asked.append(True)
        for reason in causes.refusals(plan.refused):
            print(f"batch: left out: {reason}", file=sys.stderr)
        if workflow.execution_settings is not None:  # as for --summary
            # The scenes of a batch are independent, so this target always runs as with --keep-going.
            workflow.execution_settings.keep_going = True
    return plan


def batch_targets(wildcards):
    """The summary, and every scene by itself, so that an old summary never stands for a scene that was deleted.
    Parts (`--batch batch=1/10`) divide what the summary reads, so it is alone there."""
    plan = batch_plan()
    scenes = [] if workflow.dag_settings.batch else [f"scenes/{name}" for name in plan.ready]
    refused = ["results/batch/refused"] if plan.refused else []
    again_if_unsound(
        "results/batch/complete",
        "the table and the page of the batch are made again",
        or_stop(batch_table.faults_of_the_summary),
    )
    return [*scenes, "results/batch/complete", *refused]
