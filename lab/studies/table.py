"""What a study runs, and its table: results/studies/<study>.parquet, .md and .png from the scores and times of its jobs.

The Snakefile imports this module, so heavy modules are imported inside functions.
"""

from __future__ import annotations

import hashlib
import json
import logging
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from iif_core.errors import InputError
from iif_core.evaluation.catalogue import METRICS, PROTOCOLS, PROTOCOLS_OF
from lab.costs.records import disk_mb
from lab.studies.files import RELIT, Paper, Study, load_study
from lab.studies.growth import growth_lines
from lab.studies.regret import judge, regret_lines
from lab.studies.variants import FOLDER
from workflow.artifacts.files import write_atomically
from workflow.registry import upstream_of
from workflow.runtime import fingerprint as fp
from workflow.runtime.timings import read_parts
from workflow.settings.derived import scene_of, shared_scene

if TYPE_CHECKING:
    import pandas as pd

RESULTS = Path("results/studies")
COSTS = ("seconds", "cpu_seconds", "solver_seconds", "solver_cpu_seconds", "max_rss_mb", "disk_mb")
KEY = ["scene", "quantity", "metric", "protocol"]


class Cell(NamedTuple):
    """One variant of one scene with one seed; `name` is the name of its derived scene."""

    scene: str
    variant: str
    seed: int
    name: str


class Plan(NamedTuple):
    """What a study runs, and the scenes that it leaves out with the reason."""

    study: Study
    cells: tuple[Cell, ...]
    skipped: dict[str, str]


@lru_cache(None)
def plan(name: str, quality: str) -> Plan:
    """Check the settings of every variant, and leave out the scenes whose data are missing.

    Raises:
        InputError: a mistake in the study's file or in settings that it leads to.
    """
    study = load_study(name)
    cells, skipped = [], {}
    for scene in study.scenes:
        of_scene = [
            Cell(scene, variant, seed, scene_of(name, scene, variant, seed))
            for variant in study.variants
            for seed in study.seeds_of(variant)
        ]
        for cell in of_scene:
            fp.resolved(cell.name, quality)
            fp.resolved(shared_scene(cell.name), quality)
        try:
            fp.fingerprint("prior", f"{scene}--s{study.seeds[0]}", quality)
        except InputError as error:
            skipped[scene] = str(error)
            continue
        cells.extend(of_scene)
    return Plan(study, tuple(cells), skipped)


def home(cell: Cell, quality: str, stage: str = "base_scores") -> Path:
    """Return the folder of a stage's result."""
    return Path("results") / fp.home(stage, cell.name, quality) / stage


def left_out(name: str, quality: str) -> list[str]:
    """List what the table will lack, and why."""
    study, _, skipped = plan(name, quality)
    notes = [f"without {scene}: {reason}" for scene, reason in skipped.items()]
    if any(key.endswith("lpips_vgg") for key in study.show) and not Path("results/weights/lpips_vgg.npz").is_file():
        notes.append(
            "without LPIPS (VGG16): its weights are not here; `snakemake --cores 1 results/weights/lpips_vgg.npz` fetches them"
        )
    return notes


def inputs(name: str, quality: str) -> list[str]:
    """List the manifests that the study collects; variants whose results agree share one. Stages whose costs it collects are
    listed where the scores are not made from them."""
    study, cells, _ = plan(name, quality)
    stages = {study.scores, *study.costs} - upstream_of(study.scores)
    return sorted({str(home(cell, quality, stage) / "manifest.json") for cell in cells for stage in stages})


def fingerprint(name: str, quality: str) -> str:
    """Compute a digest that changes with the study's file, its code, its scores or the scenes that can be run."""
    study, cells, skipped = plan(name, quality)
    facts = {
        "study": study.model_dump(mode="json"),
        "skipped": skipped,
        "scores": [fp.fingerprint(study.scores, cell.name, quality) for cell in cells],
        "code": fp.modules_digest(fp.modules_of("lab.studies")),
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def write_study(name: str, quality: str) -> None:
    """Write the table, the page and the picture of a study whose jobs are done."""
    from lab.studies.plots import draw

    study, cells, skipped = plan(name, quality)
    frame = table(name, quality)
    write_atomically(RESULTS / f"{name}.parquet", partial(_write_table, frame))
    text = page(study, frame, skipped)
    write_atomically(RESULTS / f"{name}.md", lambda temporary: temporary.write_text(text))
    histories = {cell: _history(cell, quality) for cell in cells} if study.plot.kind == "history" else {}
    write_atomically(RESULTS / f"{name}.png", lambda temporary: draw(study, frame, histories, temporary))
    logging.getLogger("study").info("\n%s", text)


def table(name: str, quality: str) -> pd.DataFrame:
    """Collect one row per scene, variant, seed, quantity, metric and protocol, and one per scene that was left out."""
    import pandas as pd

    study, cells, skipped = plan(name, quality)
    rows = [row for cell in cells for row in _rows(name, study, cell, quality)]
    rows += [{"study": name, "scene": scene, "status": "skipped", "reason": reason} for scene, reason in skipped.items()]
    frame = pd.DataFrame(rows, columns=[name for name, _ in COLUMNS])
    frame["pareto"] = _pareto(frame)
    return frame


def _rows(name: str, study: Study, cell: Cell, quality: str) -> list[dict[str, Any]]:
    """One row for each score of a cell."""
    variant = study.variants[cell.variant]
    facts = {
        "study": name,
        "scene": cell.scene,
        "variant": cell.variant,
        "label": variant.label or cell.variant,
        "settings": json.dumps({**variant.overrides, **({"preset": variant.preset} if variant.preset else {})}, sort_keys=True),
        "seed": cell.seed,
        **(_costs(cell, quality, study.costs) if not variant.row else {}),
        "status": "ok",
    }
    paper, rows = study.paper.get(cell.variant), []
    for (quantity, metric, protocol), (value, views) in _scores(cell, quality, study.scores, variant.row or "result").items():
        agrees = paper is not None and protocol == _protocol_of(paper, quantity)
        printed = paper.values.get(f"{quantity}/{metric}") if paper and agrees else None
        scored = {"quantity": quantity, "metric": metric, "protocol": protocol, "value": value, "views": views}
        rows.append({**facts, **scored, "paper": printed})
    return rows


KEPT = (
    *("scene", "variant", "seed", "quantity", "metric", "protocol", "value", "views"),
    *("cpu_seconds", "seconds", "max_rss_mb", "disk_mb", "fingerprint"),
)
"""Columns of the rows that outlive the folder of a study."""


def keep_rows(name: str, quality: str, path: Path) -> None:
    """Add the scores of the cells that are finished so far to a CSV file, in place of older scores of the same cells.

    Args:
        name: of the study; quality: of its runs.
        path: the file, with the columns `KEPT`; `fingerprint` is the fingerprint of the stage that scored the cell.
    """
    import pandas as pd

    study, cells, _ = plan(name, quality)
    rows = []
    for cell in cells:
        manifest = home(cell, quality, study.scores) / "manifest.json"
        found = json.loads(manifest.read_text())["fingerprint"] if manifest.is_file() else ""
        if found == fp.fingerprint(study.scores, cell.name, quality):
            rows += [{**row, "fingerprint": found} for row in _rows(name, study, cell, quality)]
    frame, cell_of = pd.DataFrame(rows, columns=list(KEPT)), ["scene", "variant", "seed"]
    done = set(map(tuple, frame[cell_of].drop_duplicates().to_numpy().tolist()))
    if path.is_file():
        older = pd.read_csv(path, dtype={"variant": str})  # runs of a design are digits
        left = [tuple(row) not in done for row in older[cell_of].to_numpy().tolist()]
        frame = pd.concat([part for part in (older[left], frame) if len(part)] or [frame])
    frame = frame.sort_values(list(KEPT[:6]), kind="stable").reindex(columns=list(KEPT))
    write_atomically(path, lambda temporary: frame.to_csv(temporary, index=False, float_format="%.6g"))
    logging.getLogger("study").info("%s: %d cells of this run, %d rows", path, len(done), len(frame))


COLUMNS = [
    *((name, "string") for name in ("study", "scene", "variant", "label", "settings")),
    ("seed", "int64"),
    *((name, "string") for name in ("quantity", "metric", "protocol")),
    ("value", "float64"),
    ("views", "int64"),
    ("paper", "float64"),
    *((name, "float64") for name in COSTS),
    ("threads", "int64"),
    ("stage_costs", "string"),
    ("pareto", "bool"),
    ("status", "string"),
    ("reason", "string"),
]


def _write_table(frame: pd.DataFrame, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {"bool": pa.bool_(), "float64": pa.float64(), "int64": pa.int64(), "string": pa.string()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in COLUMNS])
    table = pa.Table.from_pandas(frame, schema, preserve_index=False).replace_schema_metadata(None)
    pq.write_table(table, path, compression="zstd")


def _protocol_of(paper: Paper, quantity: str) -> str:
    """The protocol of a publication's numbers; `raw` for quantities to which its own does not apply."""
    return paper.protocol if quantity in RELIT or paper.protocol in PROTOCOLS_OF.get(quantity, ()) else "raw"


def _scores(cell: Cell, quality: str, stage: str, row: str) -> dict[tuple[str, str, str], tuple[float, int]]:
    """(quantity, metric, protocol) -> (mean over views, number of views)."""
    import pandas as pd

    from workflow.artifacts import StageReader

    directory = home(cell, quality, stage)
    reader = StageReader(directory, stage, directory.parent.name)
    frame = pd.DataFrame(reader.table("variants.parquet" if stage == "metrics" else "scores.parquet"))
    if "variant" in frame:
        if row not in set(frame["variant"]):
            known = ", ".join(sorted(set(frame["variant"])))
            raise InputError(f"{FOLDER}: `row: {row}` of {cell.name}: not in variants.parquet, which has {known}")
        frame = frame[frame["variant"] == row]
    means = frame.groupby(["quantity", "metric", "protocol"])["value"].agg(["mean", "count"])
    return {key: (float(row["mean"]), int(row["count"])) for key, row in means.iterrows()}


def _costs(cell: Cell, quality: str, stages: list[str]) -> dict[str, Any]:
    """Time and disk of the jobs of some stages together, their peak memory, and the time of the last one's solver (`Job.timed`).

    A value that one of the jobs did not record is None. `stage_costs`: the same of each job alone, JSON.
    """
    jobs, solver, alone = [], {}, {}
    for stage in stages:
        scene = fp.home(stage, cell.name, quality)
        parts = read_parts(scene, stage)
        job: dict[str, Any] = parts.get("job", {})
        alone[stage] = {name: job.get(name) for name in ("seconds", "cpu_seconds", "max_rss_mb")}
        jobs.append({**job, "disk_mb": _disk_mb(scene, stage)})
        solver = parts.get("solve", {})
    out: dict[str, Any] = {}
    for name, together in (("seconds", sum), ("cpu_seconds", sum), ("max_rss_mb", max), ("disk_mb", sum), ("threads", max)):
        known = [job[name] for job in jobs if job.get(name) is not None]
        out[name] = together(known) if known and len(known) == len(jobs) else None
    out["stage_costs"] = json.dumps(alone)
    return out | {f"solver_{name}": solver.get(name) for name in ("seconds", "cpu_seconds")}


def _disk_mb(scene: str, stage: str) -> float | None:
    """Size of the files of a stage; None while its manifest is not there."""
    manifest = Path("results") / scene / stage / "manifest.json"
    return disk_mb(json.loads(manifest.read_text())) if manifest.is_file() else None


def _history(cell: Cell, quality: str) -> list[dict[str, float]]:
    from workflow.artifacts import StageReader

    directory = home(cell, quality, "base")
    return StageReader(directory, "base", directory.parent.name).json("base.json")["history"]


def _pareto(frame: pd.DataFrame) -> pd.Series:
    """Whether no other variant is as cheap and better, or as good and cheaper (CPU seconds, means over the seeds)."""
    import pandas as pd

    out = pd.Series([None] * len(frame), index=frame.index, dtype=object)
    for key, group in frame[frame["value"].notna()].groupby(KEY):
        better = METRICS[key[2]].higher_is_better
        means = group.groupby("variant")[["value", "cpu_seconds"]].mean()
        if better is None or means["cpu_seconds"].isna().any():
            continue
        front = pareto_front(means["cpu_seconds"].tolist(), means["value"].tolist(), better)
        out[group.index] = group["variant"].map(dict(zip(means.index, front, strict=True)))
    return out


def pareto_front(costs: list[float], values: list[float], higher_is_better: bool) -> list[bool]:
    """Find the points to which no other point is at least as good in both values and better in one."""
    points = [(cost, -value if higher_is_better else value) for cost, value in zip(costs, values, strict=True)]
    return [not any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in points) for p in points]


def page(study: Study, frame: pd.DataFrame, skipped: dict[str, str]) -> str:
    """Format the table as Markdown: a block per metric, then the costs."""
    lines = [f"# {study.title}", ""]
    for scene, reason in skipped.items():
        lines += [f"Left out: {scene}. {reason}", ""]
    shown = frame[frame["status"] == "ok"]
    scenes = [scene for scene in study.scenes if scene not in skipped]
    if shown.empty:
        return "\n".join([*lines, "Nothing was scored.", ""])
    seeds = len(study.seeds)
    note = f"Mean over views and {seeds} seed{'s' * (seeds > 1)} of the prior" + (" (± standard deviation)" if seeds > 1 else "")
    if study.repeats:
        note += "; variants with further seeds have the standard deviation over them"
    if study.reference:
        label = study.variants[study.reference].label or study.reference
        lines += [f"In brackets: by how much a number differs from *{label}* with the same seed.", ""]
    explained = "; ".join(f"*{PROTOCOLS[protocol].short}*: {PROTOCOLS[protocol].explanation}" for protocol in study.protocols)
    lines += [f"{note}. {explained}. The paper's numbers are of other scenes; in brackets the protocol that they follow.", ""]
    front = study.plot.kind == "pareto"
    if front:
        lines += ["A star marks the Pareto front: no other variant is both better and cheaper in CPU seconds.", ""]
    labels = {name: variant.label or name for name, variant in study.variants.items()}
    for key in study.show:
        quantity, metric = key.split("/")
        chosen = shown[(shown["quantity"] == quantity) & (shown["metric"] == metric)]
        if study.rows == "scenes":
            lines += _by_scene(study, chosen, quantity, metric, scenes, labels)
            continue
        columns = [(scene, protocol) for scene in scenes for protocol in study.protocols]
        columns = [c for c in columns if ((chosen["scene"] == c[0]) & (chosen["protocol"] == c[1])).any()]
        if len(scenes) > 1 and study.scores == "metrics":
            columns += [("mean", protocol) for protocol in study.protocols if ("mean", protocol) not in columns and columns]
            columns = [c for c in columns if (chosen["protocol"] == c[1]).any()]
        if not columns:
            lines += [f"## {quantity} {METRICS[metric].label}", "", f"Not scored{_why(metric)}.", ""]
            continue
        printed = any(key in paper.values for paper in study.paper.values())
        head = [f"{scene} {PROTOCOLS[protocol].short}" for scene, protocol in columns] + ["paper"] * printed
        body = []
        for name, label in labels.items():
            row = [label]
            for scene, protocol in columns:
                cell = chosen[(chosen["protocol"] == protocol) & (chosen["variant"] == name)]
                if scene == "mean":  # of the means of the scenes, which count equally
                    row.append(_mean_cell(metric, cell.groupby("scene")["value"].mean().tolist()))
                    continue
                cell = cell[cell["scene"] == scene]
                if study.reference and name != study.reference and len(cell):
                    row.append(_moved(metric, cell, chosen, study.reference))
                    continue
                star = " *" if front and len(cell) and cell["pareto"].iloc[0] is True else ""
                row.append(_number(metric, cell["value"].tolist()) + star)
            paper = study.paper.get(name)
            if printed:
                known = paper is not None and key in paper.values
                protocol = PROTOCOLS[_protocol_of(paper, quantity)].short if paper else ""
                row.append(f"{_shown(metric, paper.values[key])} ({protocol})" if paper and known else "")
            body.append(row)
        lines += [f"## {quantity} {METRICS[metric].label}{_direction(metric)}", "", *_markdown(["variant", *head], body), ""]
    what = "the base texture" if study.costs == ["base"] else ", ".join(study.costs)
    lines += [f"## cost of {what}", "", *_costs_table(shown, scenes, labels), ""]
    if study.growth:
        lines += growth_lines(study, shown, scenes)
    if study.opposites:
        scores = [(*key.split("/"), protocol) for key in study.show for protocol in study.protocols]
        lines += regret_lines(*judge(shown, study.opposites, study.reference, scores))
    if study.design and study.design.trajectories:
        lines += _effects(study, shown, scenes)
    return "\n".join(lines)


def _by_scene(
    study: Study, chosen: pd.DataFrame, quantity: str, metric: str, scenes: list[str], labels: dict[str, str]
) -> list[str]:
    """Format one metric with a row for each scene and a column for each variant, protocol by protocol."""
    lines = []
    for protocol in study.protocols:
        own = chosen[chosen["protocol"] == protocol]
        if own.empty:
            continue
        means = own.groupby(["scene", "variant"])["value"].mean()
        cells = {(scene, name): group["value"].tolist() for (scene, name), group in own.groupby(["scene", "variant"])}
        body = [[scene, *(_number(metric, cells.get((scene, name), [])) for name in labels)] for scene in scenes]
        body.append(["mean", *(_mean_cell(metric, means[means.index.get_level_values(1) == name].tolist()) for name in labels)])
        title = f"## {quantity} {METRICS[metric].label}, {PROTOCOLS[protocol].short}{_direction(metric)}"
        lines += [title, "", *_markdown(["scene", *labels.values()], body), ""]
    return lines or [f"## {quantity} {METRICS[metric].label}", "", f"Not scored{_why(metric)}.", ""]


def _costs_table(shown: pd.DataFrame, scenes: list[str], labels: dict[str, str]) -> list[str]:
    body = []
    for scene in scenes:
        for name, label in labels.items():
            runs = shown[(shown["scene"] == scene) & (shown["variant"] == name)].groupby("seed")[list(COSTS)].first()
            digits = [0 if cost in ("max_rss_mb", "disk_mb") else 1 for cost in COSTS]
            cells = [_mean(runs[cost].dropna().tolist(), n) for cost, n in zip(COSTS, digits, strict=True)]
            body.append([scene, label, *cells])
    return _markdown(["scene", "variant", "s", "CPU s", "solver s", "solver CPU s", "peak MB", "disk MB"], body, words=2)


def _effects(study: Study, shown: pd.DataFrame, scenes: list[str]) -> list[str]:
    """Rank the factors of a screening by their effect on each score and on the costs (lab/docs/studies.md#designs)."""
    from lab.studies.screening import elementary_effects, ranked

    design, lines = study.design, []
    assert design is not None
    factors = list(design.factors)
    runs = design.runs[: design.trajectories * (len(factors) + 1)]
    wanted = [(*key.split("/"), protocol) for key in study.show for protocol in study.protocols]
    wanted += [("", "cpu_seconds", ""), ("", "max_rss_mb", "")]
    for scene in scenes:
        of_scene = shown[shown["scene"] == scene]
        for quantity, column, protocol in wanted:
            chosen = of_scene[(of_scene["quantity"] == quantity) & (of_scene["metric"] == column)] if quantity else of_scene
            chosen = chosen[chosen["protocol"] == protocol] if quantity else chosen
            means = chosen.groupby("variant")["value" if quantity else column].mean()
            if means.empty:
                continue
            found = elementary_effects(factors, runs, [means.get(run, float("nan")) for run in runs])
            title = f"{quantity} {METRICS[column].label}, {PROTOCOLS[protocol].short}" if quantity else COST_WORDS[column]
            body = []
            for factor, effect in ranked(found):
                levels = design.factors[factor]
                size = f"{effect.mean_size:.3g} ± {effect.error:.1g}"
                body.append([factor, str(levels[0]), str(levels[-1]), f"{effect.mean:+.3g}", size, f"{effect.spread:.2g}"])
            head = ["setting", "from", "to", "effect", "size", "spread"]
            lines += [f"## effects in {scene}: {title}", "", *_markdown(head, body), ""]
    return lines


COST_WORDS = {"cpu_seconds": "CPU seconds", "max_rss_mb": "peak memory in MB"}


def _why(metric: str) -> str:
    fetch = "snakemake --cores 1 results/weights/lpips_vgg.npz"
    return f": the weights of VGG16 are not there ({fetch} fetches them)" if metric == "lpips_vgg" else ""


def _direction(metric: str) -> str:
    unit = f" in {METRICS[metric].unit}" if METRICS[metric].unit else ""
    better = METRICS[metric].higher_is_better
    return unit if better is None else f"{unit} ({'higher' if better else 'lower'} is better)"


def _shown(metric: str, value: float) -> str:
    return f"{value:.3g}" if METRICS[metric].wide_range else f"{value:.{METRICS[metric].decimals}f}"


def _moved(metric: str, cell: pd.DataFrame, chosen: pd.DataFrame, reference: str) -> str:
    """Mean over the seeds, and in brackets its difference from the reference, seed by seed (± standard deviation)."""
    import numpy as np

    keys = ["scene", "protocol", "seed"]
    both = cell.merge(chosen[chosen["variant"] == reference], on=keys, suffixes=("", "_reference"))
    moved = (both["value"] - both["value_reference"]).to_numpy(np.float64)
    text = _shown(metric, float(cell["value"].mean()))
    if not len(moved):
        return text
    spread = f" ± {float(np.std(moved, ddof=1)):.1g}" if len(moved) > 1 else ""
    return f"{text} ({float(moved.mean()):+.2g}{spread})"


def _mean_cell(metric: str, values: list[float]) -> str:
    return _shown(metric, sum(values) / len(values)) if values else ""


def _number(metric: str, values: list[float]) -> str:
    import numpy as np

    if not values:
        return ""
    mean = _shown(metric, float(np.mean(values)))
    return mean if len(values) == 1 else f"{mean} ± {float(np.std(values, ddof=1)):.1g}"


def _mean(values: list[float], digits: int) -> str:
    return f"{sum(values) / len(values):.{digits}f}" if values else ""


def _markdown(head: list[str], body: list[list[str]], words: int = 1) -> list[str]:
    """Format an aligned table; the first `words` columns are left-aligned, the others right-aligned."""
    widths = [max(len(row[i]) for row in [head, *body]) for i in range(len(head))]

    def line(row: list[str]) -> str:
        cells = [
            text.ljust(width) if i < words else text.rjust(width) for i, (text, width) in enumerate(zip(row, widths, strict=True))
        ]
        return f"| {' | '.join(cells)} |"

    rule = "|" + "|".join("-" * (width + 2) if i < words else "-" * (width + 1) + ":" for i, width in enumerate(widths)) + "|"
    return [line(head), rule, *map(line, body)]
