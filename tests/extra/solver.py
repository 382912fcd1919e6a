"""In the place of stage base."""

from tests.extra import source


def run(job):
    """Write how many photographs there are."""
    job.writer.json("base.json", {"count": source.COUNT, "range": job.settings.capture.dynamic_range})
