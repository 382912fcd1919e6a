# What is said of a run when it begins and ends. Snakemake calls these functions from the hooks of the Snakefile; what is to stand
# after its own last line is registered with `atexit`.
import atexit
import subprocess

from workflow.runtime.job_state import reasons


def tell_costs():
    """Say which quality was chosen, and what the jobs that are needed will take."""
    jobs, threads = [], {}
    for job in workflow.dag.needrun_jobs(exclude_finished=False):
        stage = job.rule.name
        if stage in STAGES:
            # All jobs of a stage have the same, and Snakemake works out all resources of a job to tell them.
            if stage not in threads:
                threads[stage] = job.threads
            scene = job.wildcards.scene
            jobs.append(forecast.Planned(stage, scene, threads[stage], quality_of(scene)))
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


def forget_backups():
    """Remove copies of deliverables that Snakemake has made before a job that was killed: it fails where one is there. Publishing
    leaves a whole folder at every moment, so they are not needed."""
    for job in workflow.dag.needrun_jobs(exclude_finished=False):
        if workflow.is_main_process and job.rule.name == "publish":
            workflow.persistence.cleanup_backup(Path("scenes") / job.wildcards.scene)


def tell_reasons():
    """Say why jobs failed, after the last line of Snakemake: the last line that a user reads is the reason."""
    if not workflow.is_main_process:
        return  # a job on a node of a cluster
    if batch_asked:
        # Jobs failed, so the summary was not made: it tells of what there is. It is not `complete`, so the next run makes it.
        command = [sys.executable, "-m", "workflow", "batch", "--over", "--quality", QUALITY]
        atexit.register(subprocess.run, command, cwd=os.getcwd(), check=False)
    elif found := reasons(STARTED) or damages():
        atexit.register(print, "\n" + "\n".join(found), file=sys.stderr)


def damages():
    """What `snakemake verify` found in this run."""
    found = Path("results/verify.log")
    new = found.is_file() and found.stat().st_mtime >= STARTED
    return found.read_text().splitlines() if new else []


def tell_results():
    """Say whether scenes reached the score that was asked for and, after the last line of Snakemake, what their reports
    say and where to look: the pages of the scenes that were made, or of the batch, and the contact sheets of relightings."""
    if not workflow.is_main_process:
        return
    for line in choose.reached(REQUEST, CHOSEN):
        print(line, file=sys.stderr)
    # Of this run alone: other runs may have published in the same folder meanwhile.
    asked = {(job.rule.name, job.wildcards.scene) for job in workflow.dag.jobs if "scene" in job.wildcards.keys()}
    made = [path.parent for path in Path("scenes").glob("*/manifest.json") if ("publish", path.parent.name) in asked]
    made = [folder for folder in made if (folder / "manifest.json").stat().st_mtime >= STARTED]
    from workflow.batch.standing import verdict_of  # slow to import, and only needed at the end

    verdicts = [f"{folder.name}: {said}" for folder in sorted(made) if (said := verdict_of(folder.name))]
    pages = [folder / page for folder in sorted(made) for page in ("report.html", "room.html")]
    found_cameras = sorted(Path("results").glob("*/reconstruction/overview.png"))
    pages += [path for path in found_cameras if ("reconstruction", path.parts[1]) in asked and path.stat().st_mtime >= STARTED]
    if batch_asked:
        pages = [Path("results/batch/report.html")]
    sheets = [path for path in sorted(Path("relight").glob("**/contact_sheet.png")) if path.stat().st_mtime >= STARTED]
    relit = {scene for rule, scene in asked if rule in ("relit", "relit_plan")}
    pages += [path for path in sheets if path.parts[1] in relit]
    found = [str(page.resolve()) for page in pages if page.is_file()]
    if found:
        said = "".join(f"\n{line}" for line in ([] if batch_asked else verdicts))
        atexit.register(print, f"{said}\nOpen: " + "\n      ".join(found), file=sys.stderr)
