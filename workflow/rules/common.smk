# Functions that choose names, inputs and parameters for the rules. Nothing is computed here.
import json
import os
import re
import sys
import time
from contextlib import suppress
from pathlib import Path

from snakemake.cli import get_argument_parser

# The folder of this workflow, also where another Snakefile takes it as a module; jobs that Snakemake starts elsewhere need it too.
CHECKOUT = str(Path(workflow.current_basedir).parents[1])
sys.path.insert(0, CHECKOUT)

from iif_core.errors import InputError
from workflow.artifacts import links, sound
from workflow.batch import causes
from workflow.batch import plan as batch_table
from workflow.comparison import named as comparison
from workflow.registry import SHARED
from workflow.runtime import fingerprint as fingerprints
from workflow.runtime import events, forecast, native
from workflow.runtime.attempts import RUN, written_out
from workflow.status import table as status
from workflow.relighting import copies
from workflow.relighting.check import check_relightings
from workflow.settings import SCENE_NAME, scene_file
from workflow.settings.names import did_you_mean_path
from workflow.settings import prior as prior_settings
from workflow.settings import refuse_profile, refuse_scatter, refuse_target, study_files
from workflow.trade import bench, choose

STARTED = time.time()
FOLDER = os.getcwd()
SCATTERED = ("prior",)  # rules of `scattergather` in stages.smk

native.process_environment()
if workflow.is_main_process:
    # Jobs inherit it, also those on other machines, so that they know attempts of this run from those of earlier ones.
    os.environ[RUN] = f"{STARTED:.3f}-{os.getpid()}"


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


# `--config`: a quality by name, or for each scene the one that a number of seconds or a score asks for.
REQUEST = or_stop(
    choose.read,
    config,
    set(workflow.config_settings.overwrite_config or {}),
    workflow.resource_settings.cores,
)
QUALITY = REQUEST.quality  # of batches and comparisons
CHOSEN = {}


def tell_status():
    """Answer `snakemake status` and end: here, while rules are read, because afterwards Snakemake would wait for the lock that a run
    holds, or refuse to go on. The file that Snakemake has opened for the log of this call is removed, since no job will write to it.
    """
    # Internals of Snakemake, and nothing that the answer needs.
    with suppress(Exception):
        for handler, path in list(workflow.logger_manager.logfile_handlers.items()):
            if os.path.isfile(path) and Path(path).parent.name == "log":
                workflow.logger_manager.logger.removeHandler(handler)
                handler.close()
                os.unlink(path)
    sys.exit(status.tell([], lambda scene: choose.choice(REQUEST, scene).quality))


def targets():
    """Targets of the command line; Snakemake itself knows them only when all rules are read."""
    return list(get_argument_parser().parse_args().targets)


def profile_or_stop():
    """Refuse a workflow profile that is not there. Snakemake read it in the folder where it was called, and with `--directory` it is
    in another one now, and does not say which that was; the shell does."""
    given = get_argument_parser().parse_args()
    start = os.environ.get("PWD", FOLDER) if given.directory else FOLDER
    or_stop(refuse_profile, given.workflow_profile, Path(start), Path(CHECKOUT))


or_stop(refuse_scatter, workflow.resource_settings.overwrite_scatter, SCATTERED)


# Only where there is something to check: Snakemake takes half a second to read its arguments.
if workflow.is_main_process and any(
    word.startswith("--workflow-p") for word in sys.argv
):
    profile_or_stop()


if workflow.is_main_process and "status" in sys.argv and targets() == ["status"]:
    tell_status()


for place in (".", "results", "scenes", ".snakemake"):
    if os.path.exists(place) and not os.access(place, os.W_OK):
        stop(
            f"{os.path.realpath(place)}: not writable for you; results and records are written there."
            " Give yourself the right, or work in a copy of the checkout."
        )


if config.get("events") is not None:
    # Jobs inherit it, also those that Snakemake starts on other machines, because it hands `--config` on to them.
    os.environ[events.VARIABLE] = or_stop(
        events.checked, str(config["events"]), workflow.is_main_process
    )


def quality_of(scene):
    """The quality of a scene; it is chosen once in a run."""
    if scene not in CHOSEN:
        CHOSEN[scene] = or_stop(choose.choice, REQUEST, scene)
    return CHOSEN[scene].quality


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


def reads(stage, *names):
    """Named inputs of a stage: the manifests of the stages `names`, which must be those of workflow/registry.py.

    The scene is checked first, so that bad input stops before any job. Variants of a study share what they have in common, and
    what is read from the scene that they share has `shared_` before its name.
    """
    shared = [name.removeprefix(SHARED) for name in names if name.startswith(SHARED)]
    own = tuple(name for name in names if not name.startswith(SHARED))
    assert own == fingerprints.STAGES[stage].upstream, (stage, names)
    assert tuple(shared) == fingerprints.STAGES[stage].shared, (stage, names)

    def inputs(wildcards):
        quality = quality_of(wildcards.scene)
        # Rule publish makes the deliverable, and its stage with it.
        published = stage == "publish"
        home = f"results/{wildcards.scene}/{stage}/manifest.json"
        again_if_unsound(
            f"scenes/{wildcards.scene}" if published else home,
            f"{wildcards.scene}: stage {stage} is made again",
            or_stop(batch_table.check_stage, stage, wildcards.scene, quality),
        )
        common = study_files.shared_scene(wildcards.scene)
        found = {name: manifest(name, wildcards.scene) for name in own}
        return found | {f"{SHARED}{name}": manifest(name, common) for name in shared}

    return inputs


def manifest(stage, scene):
    """Manifest of a stage, in the folder of the scene that computes it."""
    home = fingerprints.home(stage, scene, quality_of(scene))
    return f"results/{home}/{stage}/manifest.json"


told_of_scatter = set()


def with_parts(inputs_of):
    """Inputs of stage prior: those of any stage and, where it is scattered, the jobs that make its parts."""

    def inputs(wildcards):
        found = inputs_of(wildcards)
        parts = parts_of_prior(wildcards.scene)
        return found | {"parts": parts} if parts else found

    return inputs


def parts_of_prior(scene):
    """Marks of the parts into which the prior of a scene is scattered (`--set-scatter prior=8`); none by default.

    A finished prior keeps the inputs that it was made from, so that it is not made again because it is asked for in more parts, in
    fewer, or in none: Snakemake compares the names of inputs.
    """
    output = workflow.get_rule("prior").output.manifest
    name = output.apply_wildcards({"scene": scene})  # of Snakemake's own type
    quality = quality_of(scene)
    mark = or_stop(fingerprints.fingerprint, "prior", scene, quality)
    made = os.path.isfile(name) and "prior" not in workflow.dag_settings.forcerun
    if made and not or_stop(sound.stage_faults, Path("results"), scene, "prior", mark):
        made_from = workflow.persistence.input(name) or []
        return [
            path for path in made_from if path.startswith(f"results/{scene}/parts/")
        ]
    parts = gather.prior("results/{scene}/parts/prior.{scatteritem}", scene=scene)
    if len(parts) < 2:
        return []
    kind = resolved(scene)["prior"]["kind"]
    grouped = workflow.group_settings.overwrite_groups
    why = ""
    if not prior_settings.by_view(kind):
        why = f"prior {kind} first gathers the light of all photographs, and every part would do that again"
    elif grouped.get("prior") != grouped.get("prior_part"):
        why = "in this profile the stages of a scene are one job; use workflow/profiles/slurm"
    if why and scene not in told_of_scatter and workflow.is_main_process:
        print(f"{scene}: --set-scatter prior has no effect: {why}", file=sys.stderr)
    told_of_scatter.add(scene)
    return [] if why else parts


def job(stage):
    """Arguments of `python3 -m workflow` for a stage; the fingerprint makes Snakemake run again what changed, and only that.

    It must be a function of the wildcards alone: Snakemake does not compare parameters that depend on inputs or outputs.
    """

    def arguments(wildcards):
        scene, quality = wildcards.scene, quality_of(wildcards.scene)
        mark = or_stop(fingerprints.fingerprint, stage, scene, quality)
        return f"{stage} {scene} --quality {quality} --fingerprint {mark}"

    return arguments


def on_nodes():
    """Whether jobs are submitted to a cluster; each has its own Snakemake there."""
    plugin = workflow.executor_plugin
    return plugin is not None and plugin.common_settings.non_local_exec


def needs(stage):
    """Memory, time and disk that a job of a stage asks for, by the cost model; memory and time grow with every retry."""

    def value(of, grows):
        def resource(wildcards, threads, attempt):
            scene, quality = wildcards.scene, quality_of(wildcards.scene)
            cost = or_stop(forecast.job_cost, stage, scene, quality, threads)
            return of(cost) * (attempt if grows else 1)

        return resource

    return {
        "mem_mb": value(lambda cost: forecast.memory_mb(cost, on_nodes()), True),
        "runtime": value(forecast.minutes, True),
        "disk_mb": value(forecast.disk_mb, False),
    }


def resolved(scene):
    """All settings of a scene, as plain values."""
    return json.loads(or_stop(fingerprints.resolved, scene, quality_of(scene)))


def no_stage(wildcards):
    """Input of the template, which is not to be run."""
    stop(f"results/{wildcards.scene}/stage: no stage has this name")


# ----------------------------------------------------------------------------------------------------- deliverables


def publish_inputs(*names):
    """What is published. A deliverable is published again if one of its files is missing, or if it is not the one that is wanted."""
    inputs_of = reads("publish", *names)

    def inputs(wildcards):
        folder = f"scenes/{wildcards.scene}"
        folder_or_stop(folder)
        quality = quality_of(wildcards.scene)
        mark = or_stop(fingerprints.fingerprint, "publish", wildcards.scene, quality)
        again_if_unsound(
            folder,
            f"{folder} is published again",
            or_stop(
                sound.deliverable_faults,
                Path(folder),
                Path("results"),
                wildcards.scene,
                mark,
            ),
        )
        return inputs_of(wildcards)

    return inputs


def relit_inputs(wildcards):
    """The relightings of a scene, or one plan of them; those with a missing picture are copied again."""
    scene, plan = wildcards.scene, wildcards.get("plan", "")
    folder = f"relight/{scene}/{plan}" if plan else f"relight/{scene}"
    asked = [
        name
        for name in workflow.dag_settings.targets
        if Path(name).parts[:2] == ("relight", scene)
    ]
    if len({len(Path(name).parts) for name in asked}) > 1:
        stop(
            f"relight/{scene} holds the plans that were asked for, and Snakemake makes a folder and what lies in it only one after"
            f" the other. Ask twice: first `relight/{scene}`, then {' '.join(name for name in asked if name.count('/') > 1)}."
        )
    if os.path.isdir(folder) and not os.path.isfile(f"{folder}/contact_sheet.png"):
        workflow.dag.forcefiles.add(folder)  # it holds plans alone
    source = or_stop(copies.source, scene, plan, quality_of(scene))
    folder_or_stop(folder)
    again_if_unsound(
        folder,
        f"{folder} is copied again",
        or_stop(sound.copy_faults, Path(folder), Path("results"), source, "relight"),
    )
    return {"manifest": f"results/{source}/relight/manifest.json"}


def folder_or_stop(folder):
    """Refuse a file in the place of a folder, which Snakemake would take for the finished folder."""
    or_stop(links.check_folder, folder)


def again_if_unsound(target, words, faults):
    """Have the job run that makes `target`, if what is there is not what was written, and say once why."""
    if faults and workflow.is_main_process and target not in workflow.dag.forcefiles:
        if text := sound.told(faults, words):
            print(written_out(text), file=sys.stderr)
        workflow.dag.forcefiles.add(target)


def plan_inputs(wildcards):
    """The plan of a scene; if it is missing from plan/<scene>/, it is written there again."""
    folder = Path("plan") / wildcards.scene
    folder_or_stop(str(folder))
    if folder.is_dir() and not (folder / "plan.yaml").is_file():
        workflow.dag.forcefiles.add(str(folder))
    return {"manifest": manifest("plan", wildcards.scene)}


def bench_inputs(wildcards):
    """Scores of the three points that are run in this room; a bench with a missing file is written again."""
    folder = f"bench/{wildcards.scene}"
    folder_or_stop(folder)
    names = ("bench.json", "bench.md")
    if os.path.isdir(folder) and not all(
        os.path.exists(f"{folder}/{name}") for name in names
    ):
        workflow.dag.forcefiles.add(folder)
    return [
        manifest("metrics", scene) for scene in bench.scenes(wildcards.scene).values()
    ]


def compared(wildcards):
    """Digest of the two results of a comparison; one that is not there stops here, before any job."""
    folder_or_stop(f"compare/{wildcards.first},{wildcards.second}")
    names = wildcards.first, wildcards.second
    for name in names:
        if "--" not in name and not os.path.isdir(f"results/{name}"):
            or_stop(scene_file, name)
    return or_stop(comparison.mark, *names, QUALITY)


def scored_inputs(*names):
    """What maps are scored against; without maps, or with none that are there, the run stops here."""
    inputs_of = reads("metrics", *fingerprints.STAGES["metrics"].upstream)

    def inputs(wildcards):
        folder_or_stop(f"score/{wildcards.scene}")
        if not config.get("maps"):
            stop(
                f"score/{wildcards.scene}: whose maps? Give their folder: --config maps=<folder>, with albedo/<view>.exr or"
                " .png, roughness/, metallic/ and so on (docs/guide/comparing.md)"
            )
        found = inputs_of(wildcards)
        return {name: found[name] for name in names}

    return inputs


def scored(wildcards):
    """Arguments of the command that scores maps, and a digest of them, which Snakemake compares."""
    folder, colour = Path(str(config.get("maps", ""))), str(
        config.get("colour", "auto")
    )
    if not folder.is_dir():
        stop(
            f"--config maps={folder}: no such folder; a relative path counts from {os.getcwd()}.{did_you_mean_path(folder)} Give the"
            " folder that holds albedo/<view>.exr or .png, roughness/, metallic/ and so on (docs/guide/comparing.md)"
        )
    quality = quality_of(wildcards.scene)
    mark = or_stop(comparison.digest_of_maps, folder, colour)
    return {
        "folder": str(folder),
        "colour": colour,
        "quality": quality,
        "mark": mark,
    }


def relight_inputs(*names):
    """What is relit; a scene without relightings, or one of which something does not exist, stops here, before any job."""
    inputs_of = reads("relight", *names)

    def inputs(wildcards):
        found, scene = inputs_of(wildcards), wildcards.scene
        or_stop(check_relightings, resolved(scene), scene, quality_of(scene))
        return found

    return inputs


# ---------------------------------------------------------------------------------------------------------- targets


def made_by_no_rule():
    """Pattern of every path that no rule makes that was read so far."""
    patterns = [
        output.regex().pattern for rule in workflow.rules for output in rule.output
    ]
    unnamed = (re.sub(r"\(\?P<\w+>", "(?:", pattern) for pattern in patterns)
    return "(?!" + "|".join(f"(?:{pattern})" for pattern in unnamed) + ").+"


def unknown(wildcards):
    """Ends with what is wrong about a target that no rule makes, or about a name that no scene can have."""
    folder, _, name = wildcards.target.partition("/")
    if folder == "scenes" and "/" not in name:
        or_stop(scene_file, name)
    rules = [rule.name for rule in workflow.rules if rule.name != "unknown_target"]
    or_stop(refuse_target, wildcards.target, rules)


def status_alone(wildcards):
    """Input of `status`. Alone, `status` is answered before any rule is looked at; with other targets it ends here."""
    stop(
        "status: ask for it alone, `snakemake status`; of some scenes, `python -m workflow status <scene> ...`"
    )


# ------------------------------------------------------------------------------------------------------------ batch
# An input function that raises ends Snakemake's plan for all scenes, so each scene is checked first and a bad one is kept
# out of the plan. A scene whose job fails does not stop the others. Snakemake ends with an error when the others are done.

batch_asked = []


def batch_plan():
    """What can be run; a table that cannot be read stops here, before any job."""
    if REQUEST.key in ("budget", "target"):
        stop(
            f"--config {REQUEST.key}={REQUEST.value}: it is for scenes that are named, such as scenes/kitchen; a batch has one"
            " quality, so that its scenes can be compared. Give it quality=... or point=..."
        )
    plan = or_stop(batch_table.plan, QUALITY)
    if not batch_asked:
        batch_asked.append(True)
        for reason in causes.refusals(plan.refused):
            print(f"batch: left out: {reason}", file=sys.stderr)
        if (
            workflow.execution_settings is not None
        ):  # None where nothing is run, as for --summary
            # The scenes of a batch are independent, so this target always runs as with --keep-going.
            workflow.execution_settings.keep_going = True
    return plan


def batch_targets(wildcards):
    """The summary, and every scene by itself, so that an old summary never stands for a scene that was deleted.
    Parts (`--batch batch=1/10`) divide what the summary reads, so it is alone there."""
    plan = batch_plan()
    scenes = (
        [] if workflow.dag_settings.batch else [f"scenes/{name}" for name in plan.ready]
    )
    refused = ["results/batch/refused"] if plan.refused else []
    again_if_unsound(
        "results/batch/complete",
        "the table and the page of the batch are made again",
        or_stop(batch_table.faults_of_the_summary),
    )
    return [*scenes, "results/batch/complete", *refused]
