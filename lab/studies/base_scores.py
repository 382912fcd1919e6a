"""Stage base_scores: scores of the base texture against ground truth in every view, which studies collect."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from iif_core.errors import InputError
from iif_core.evaluation import metrics
from iif_core.reflectance.material import PROPERTIES
from workflow.artifacts.store import material_maps
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader
from workflow.scoring import scores as scoring


def run(job: Job) -> None:
    """Write scores.parquet (every view) and scores.json (means, what could not be scored).

    Raises:
        InputError: the capture has no ground truth.
    """
    capture = CaptureReader(job.read("capture"))
    if not capture.has_truth:
        raise InputError(f"scene {job.scene}: no ground truth to score against; a study needs a source with truth")
    networks = scoring.perceptual_networks(with_vgg=True)
    # The VGG network takes most of the time, and the paper reports it for albedo only.
    networks_of = {q: networks if q == "albedo" else {"alex": networks["alex"]} for q in PROPERTIES}
    rows = scoring.ScoreRows()
    is_raw = job.read("base").json("base.json")["variant"] == "raw"

    def scores_of(index: int) -> list[tuple[str, list[metrics.Score]]]:
        view = capture.views[index]
        file = f"maps/{view.name}.exr"
        if not job.read("base").has(file):
            return []
        channels = job.read("base").exr(file)
        maps = material_maps(channels)
        truth = scoring.material_truth(capture, job.read("segmentation"), view, networks_of)
        return [(q, truth.scores(maps, q)) for q in PROPERTIES]

    with ThreadPoolExecutor(job.threads) as pool:
        # `map` keeps the order of the views, so the table does not depend on the number of threads.
        for done, scored in enumerate(pool.map(scores_of, range(len(capture.views)))):
            for quantity, of_view in scored:
                rows.add("base", capture.views[done].name, quantity, of_view)
            job.progress(done + 1, len(capture.views), "views scored")
    if not is_raw:  # raw predictions have no uncertainty
        truth = scoring.cell_truth(capture, job.read("segmentation"), job.read("base"))
        k = job.read("base").json("base.json")["predictions"]
        for quantity, of_scene in scoring.interval_scores(job.read("base").table("cells.parquet"), truth, k):
            rows.add("base", "all", quantity, of_scene)
    job.writer.table("scores.parquet", rows.table(job.scene, {"base"}), scoring.UNITS)
    job.writer.json("scores.json", {"means": rows.means().get("base", {}), "not_scored": rows.missing})
