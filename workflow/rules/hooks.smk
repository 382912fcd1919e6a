# What is said of a run, and checked, when it begins and ends. Snakemake calls these functions from the hooks of the Snakefile; what
# is to stand after its own last line is registered with `atexit`.
import atexit
import shlex
import subprocess

from workflow.runtime import slurm
from workflow.runtime.job_state import reasons, retold

# ------------------------------------------------------------------------------------------------------------- costs


def tell_costs():
    """Say which quality was chosen, and what the jobs that are needed will take."""
    jobs, threads = [], {}
    for job in workflow.dag.needrun_jobs(exclude_finished=False):
        stage = job.rule.name
        if stage in fingerprints.STAGES:
            # All jobs of a stage have the same, and Snakemake works out all resources of a job to tell them.
            if stage not in threads:
                threads[stage] = job.threads
            scene = job.wildcards.scene
            jobs.append(
                forecast.Planned(stage, scene, threads[stage], quality_of(scene))
            )
    for line in forecast.forecast(jobs, workflow.cores):
        print(line, file=sys.stderr)
    scenes = {job.scene for job in jobs if choose.fits(job.stage, job.scene)}
    chosen = {scene: choice for scene, choice in CHOSEN.items() if scene in scenes}
    for line in choose.told(REQUEST, chosen) if chosen else []:
        print(line, file=sys.stderr)


def tell_costs_of_dry_run():
    """The same at the end of a dry run, for which Snakemake has no hook. By then it has returned to the folder of the caller."""
    if workflow.is_main_process and workflow.dryrun and workflow.dag is not None:
        os.chdir(FOLDER)
        tell_costs()


atexit.register(tell_costs_of_dry_run)


# ----------------------------------------------------------------------------------------------------------- cluster


def submission():
    """The command that submits jobs to Slurm, empty where Slurm's own executor does it; None where jobs do not go to Slurm."""
    plugin = workflow.executor_plugin
    command = getattr(workflow.executor_settings, "submit_cmd", None) or ""
    if plugin is not None and plugin.name == "slurm":
        return ""
    return command if "sbatch" in command else None


def partitions_of(unit):
    """Names of the partitions that a job is submitted to, as far as anything names them."""
    named = unit.resources.get("slurm_partition")
    if command := submission():
        options = command.partition("sbatch")[2]
        option = re.search(r"(?:--partition[= ]|-p )(\S+)", options)
        named = option[1] if option else os.environ.get("SBATCH_PARTITION")
    return tuple(filter(None, re.split(r"[,\s]+", str(named or ""))))


def asked_of_a_node(job):
    """What a job, or the group of jobs that is submitted as one, asks of a node."""
    group = workflow.dag.get_job_group(job)
    unit = group or job
    rules = {one.rule.name: one.threads for one in (group.jobs if group else [job])}
    memory, partitions = unit.resources.get("mem_mb"), partitions_of(unit)
    scene = job.wildcards.get("scene", "")
    what = f"the job of {len(rules)} stages" if len(rules) > 1 else job.rule.name
    described = getattr(workflow.executor_settings, "partition_config", None)
    return slurm.Asked(
        f"{what} of {scene}" if scene else what,
        rules,
        unit.threads,
        memory if isinstance(memory, int) else None,
        partitions,
        not partitions and bool(described),
    )


def refuse_too_large():
    """Stop before anything is submitted if a job asks for more than any node has: Slurm would let it wait for ever."""
    if submission() is None:
        return
    Path(slurm.REFUSALS).unlink(missing_ok=True)  # of an earlier run
    jobs = workflow.dag.needrun_jobs(exclude_finished=False)
    asked = [asked_of_a_node(job) for job in jobs if not job.is_local]
    if asked and (found := slurm.too_large(asked, slurm.nodes())):
        stop("\n       ".join(found))


# ------------------------------------------------------------------------------------------------------------ errors


def tell_lock():
    """Give the command that removes a lock, after Snakemake's message that the folder is locked."""
    runs = workflow.execution_settings is not None and not workflow.dryrun
    if workflow.is_main_process and runs and workflow.dag is not None:
        os.chdir(FOLDER)
        if workflow.persistence.locked:
            again = shlex.join(["snakemake", *sys.argv[1:]])
            print(
                f"\nerror: another run holds this folder, or was killed in it. If none is running: `{again} --unlock`, then"
                f" `{again}`",
                file=sys.stderr,
            )


if "--unlock" not in sys.argv:
    atexit.register(tell_lock)


def tell_reasons(logs):
    """Say why jobs failed, after the last line of Snakemake: the last line that a user reads is the reason."""
    if not workflow.is_main_process:
        return  # a job on a node of a cluster
    refused = refused_by_slurm(logs)
    if refused:  # registered first, so printed last
        atexit.register(print, "\n" + "\n".join(refused), file=sys.stderr)
    if batch_asked:
        # Jobs failed, so the summary was not made: it tells of what there is. It is not `complete`, so the next run makes it.
        command = [sys.executable, "-m", "workflow", "batch", "--quality", QUALITY]
        atexit.register(subprocess.run, command, cwd=os.getcwd(), check=False)
    elif found := reasons(STARTED) or ([] if refused else damages()):
        atexit.register(print, "\n" + "\n".join(found), file=sys.stderr)


def refused_by_slurm(logs):
    """One message for every reason for which Slurm refused jobs in this run: they never began, so nothing else tells of them."""
    if submission() is None:
        return []
    text = "\n".join(
        Path(path).read_text(errors="replace") for path in logs if os.path.isfile(path)
    )
    return [
        written_out(f"error: Slurm refused a job: {reason}")
        for reason in slurm.refusals(text)
    ]


def tell_attempts():
    """Say which jobs needed several attempts in this run, and how the attempts ended that did not do it."""
    if workflow.is_main_process and (found := retold(STARTED)):
        atexit.register(print, "\n" + "\n".join(found), file=sys.stderr)


def damages():
    """What `snakemake verify` found in this run."""
    found = Path("results/verify.log")
    new = found.is_file() and found.stat().st_mtime >= STARTED
    return found.read_text().splitlines() if new else []


# ----------------------------------------------------------------------------------------------------------- results


def tell_target():
    """Say of each scene that was made whether it reached the score that was asked for."""
    for line in choose.reached(REQUEST, CHOSEN):
        print(line, file=sys.stderr)


PAGES = ("report.html", "room.html")


def made_now(folder, pattern):
    """Files below a folder that were written since this run began."""
    paths = sorted(folder.glob(pattern))
    return [path for path in paths if path.stat().st_mtime >= STARTED]


def tell_pages():
    """Say where to look, after the last line of Snakemake: the pages of the scenes that were made, or of the batch, and the contact
    sheets of relightings."""
    if not workflow.is_main_process:
        return  # a job on a node of a cluster
    folders = [path.parent for path in made_now(Path("scenes"), "*/manifest.json")]
    pages = [folder / page for folder in folders for page in PAGES]
    if batch_asked:
        pages = [Path("results/batch/report.html")]
    for pattern in ("*/contact_sheet.png", "*/*/contact_sheet.png"):
        pages += made_now(Path("relight"), pattern)
    found = [str(page.resolve()) for page in pages if page.is_file()]
    if found:
        atexit.register(print, "\nOpen: " + "\n      ".join(found), file=sys.stderr)
