# Shared by all rules: the import path, the fingerprint of a stage, and the command of a job. Nothing is computed here.
import os
import sys

sys.path.insert(0, workflow.basedir)

from iif_core.errors import InputError
from workflow.runtime import fingerprint as fingerprints
from workflow.runtime import native
from workflow.settings import QUALITIES, SCENE_NAME, scene_file

native.process_environment()


def stop(message):
    """End with one message for the user instead of a traceback through Snakemake."""
    print(f"\nerror: {message}\n", file=sys.stderr)
    sys.exit(1)


for place in (".", "results", "scenes", ".snakemake"):
    if os.path.exists(place) and not os.access(place, os.W_OK):
        stop(
            f"{os.path.realpath(place)}: not writable for you; results and records are written there."
            " Give yourself the right, or work in a copy of the checkout."
        )


QUALITY = str(config.get("quality", "draft"))
if QUALITY not in QUALITIES:
    stop(
        f"--config quality={QUALITY}: unknown quality; allowed: {', '.join(QUALITIES)}"
    )
if set(config) - {"quality"}:
    stop(
        f"--config {', '.join(sorted(set(config) - {'quality'}))}: unknown key; allowed: quality."
        " Everything else belongs into config/scenes/<scene>.yaml (docs/settings.md)."
    )


wildcard_constraints:
    scene=SCENE_NAME,


def manifest(stage, scene):
    """Manifest of a stage; variants of a study share what they have in common."""
    return f"results/{fingerprints.home(stage, scene, QUALITY)}/{stage}/manifest.json"


def upstream(stage):
    """Manifests of the stages that `stage` reads. Checks the scene first, so that bad input stops before any job."""

    def inputs(wildcards):
        try:
            fingerprints.fingerprint(stage, wildcards.scene, QUALITY)
        except InputError as error:
            stop(error)
        return [
            manifest(name, wildcards.scene)
            for name in fingerprints.STAGES[stage].upstream
        ]

    return inputs


def unknown(wildcards):
    """Ends with what is wrong about a scene that can have no file."""
    try:
        return str(scene_file(wildcards.name))
    except InputError as error:
        stop(error)


def job(stage):
    """Arguments of `python -m workflow` for a stage; the fingerprint makes Snakemake rerun what changed, and only that."""

    def arguments(wildcards):
        mark = fingerprints.fingerprint(stage, wildcards.scene, QUALITY)
        return f"{stage} {wildcards.scene} --quality {QUALITY} --fingerprint {mark}"

    return arguments
