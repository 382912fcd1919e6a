"""Stage plan before the published method, which decides about the components of the model itself."""

from workflow.decisions.record import PROVISIONAL, SETTLED, Decision, not_probed
from workflow.runtime.job import Job
from workflow.scene.normal_form import CaptureReader
from workflow.stages.plan import write


def run(job: Job) -> None:
    """Write plan.json and plan.yaml, without looking at a photograph."""
    write(job, CaptureReader(job.read("capture")), not_planned(), {})


def not_planned() -> list[Decision]:
    """Return the components of the published method."""
    names = ("environment", "emitters", "radiance_cache", "metallic", "affine_size", "denoiser")
    out = [not_probed(name, True, "the published method is not planned", PROVISIONAL) for name in names]
    return [*out, not_probed("specular", True, "the published method traces all lobes", SETTLED)]
