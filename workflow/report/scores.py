"""The scores of the report: the sentence under its first picture, the numbers at its head, the tables, and their explanations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from iif_core.evaluation.catalogue import METRICS, PROTOCOLS
from workflow.report.page import Number, Table
from workflow.report.verdict import LIMITS

Means = Mapping[str, Any]
"""Variant -> quantity -> protocol -> metric -> {mean, views}: `means` of summary.json of stage metrics."""

VARIANT_NAMES = {
    "prior_k0": "raw prediction (first)",
    "prior_mean_k": "raw predictions (mean score)",
    "object_mean": "mean per object",
    "texel_mean": "mean per surface cell",
    "photo_mean": "mean of the other photographs",
    "photo_nearest": "blend of the nearest photographs",
    "photo_as_albedo": "mean photograph as albedo",
    "base": "base texture (fused)",
    "corrected": "result, with unexplained light",
    "result": "result",
}

METRIC_WORDS = {
    "l2": "mean squared error, of linear values for maps and of sensor values for photographs; 0 is exact",
    "psnr": "peak signal-to-noise ratio, 10 log10(1 / L2) in dB: 20 dB is an error of 0.1, 30 dB one of 0.03; larger is better",
    "ssim": "structural similarity of 11 x 11 pixels (Gaussian of 1.5 pixels); 1 is equal",
    "flip": "difference that an eye sees when two pictures alternate; 0 is none",
    "lpips": "distance in the features of AlexNet; 0 is equal",
    "lpips_vgg": "distance in the features of VGG16; 0 is equal",
    "log_l2": "mean squared error of log(1 + E), which bright lamps do not drown; 0 is exact",
    "iou": "pixels that emit in both, over pixels that emit in either; 1 is equal",
    "shading_left": "correlation, inside objects, of log albedo with the log of the light that was found; 0 is none left",
    "shading_slope": "slope, inside objects, of log albedo over the log of the light; 0 is none left",
    "view_spread": "spread over photographs of the log albedo of the same surface; 0 is none",
    "light_spread": "spread over objects of the logarithm of the light's error; 0.1 is 10 %",
}
"""Metric -> what it measures, for people who meet it here first (docs/method/evaluation.md)."""

HEADS = (
    ("re-rendering, held-out photographs", "rgb_held_out", "raw", "psnr", "rerendering"),
    ("re-rendering of the photographs", "rgb", "raw", "psnr", "rerendering"),
    ("albedo, as it is", "albedo", "raw", "psnr", "albedo"),
    ("albedo, up to scale", "albedo", "scaled", "psnr", "albedo"),
    ("roughness", "roughness", "raw", "psnr", "roughness"),
    ("metallic", "metallic", "raw", "psnr", "metallic"),
    ("light left in the albedo", "albedo", "raw", "shading_left", ""),
)
"""Scores at the head of the page: label, quantity, protocol, metric, and the limit of the verdict above which it is good."""


WORSE = 0.1
"""Decibels by which the result is worse than the fused predictions from which the page says so."""


def found(means: Means, quantity: str, protocol: str, metric: str, variant: str = "result") -> dict[str, Any]:
    """Return mean and number of views of a score; empty where there is none."""
    return means.get(variant, {}).get(quantity, {}).get(protocol, {}).get(metric, {})


def headline(summary: Mapping[str, Any], has_lamps: bool, has_truth: bool) -> str:
    """Return the sentences under the first picture, from summary.json of stage metrics: how near re-renderings come to the
    photographs, and albedo to the truth."""
    means = summary["means"]
    psnr, held_out = (found(means, quantity, "raw", "psnr") for quantity in ("rgb", "rgb_held_out"))
    corrected, corrected_held_out = (found(means, quantity, "raw", "psnr", "corrected") for quantity in ("rgb", "rgb_held_out"))
    text = f"Re-renderings reach {psnr['mean']:.1f} dB PSNR on the photographs (sensor values)." if psnr else ""
    if corrected:
        text += f" With the light that the model lacks, as the other photographs show it: {corrected['mean']:.1f} dB."
    if held_out:
        count = held_out["views"]
        text += f" On the {f'{count} held-out photographs' if count != 1 else 'held-out photograph'}: {held_out['mean']:.1f} dB"
        text += f", with that light {corrected_held_out['mean']:.1f} dB." if corrected_held_out else "."
        mean, blend = (found(means, "rgb_held_out", "raw", "psnr", variant) for variant in ("photo_mean", "photo_nearest"))
        if mean and blend:
            text += f" The mean of the other photographs, with no model of light, reaches {mean['mean']:.1f} dB,"
            text += f" and a blend of the nearest ones {blend['mean']:.1f} dB."
    gain = summary.get("gain_over_raw_predictions", {}).get("albedo", {}).get("scaled", {}).get("psnr_db")
    if gain is not None:
        raw, own, plain = (
            found(means, "albedo", *column) for column in (("raw", "psnr"), ("scaled", "psnr"), ("scaled", "psnr", "object_mean"))
        )
        uncorrected = f"{raw['mean']:.1f} dB as it is and " if raw else ""
        text += f" Against ground truth, albedo reaches {uncorrected}{own['mean']:.1f} dB up to scale,"
        text += f" {gain:.1f} dB above predictions"
        text += f"; one flat colour per object, the mean of its predictions, reaches {plain['mean']:.1f} dB" if plain else ""
        taken = found(means, "albedo", "scaled", "psnr", "photo_as_albedo")
        text += f"; the mean photograph, taken for albedo, {taken['mean']:.1f} dB." if taken else "."
        fused = found(means, "albedo", "scaled", "psnr", "base")
        if fused and own["mean"] < fused["mean"] - WORSE:
            text += f" The fit made it worse: the fused predictions that it starts from reach {fused['mean']:.1f} dB."
    if not has_lamps:
        text += " No lamp was found, so relighting has none to switch off."
    if gain is None and not has_truth:
        text += " There is no ground truth for this scene: materials are judged by re-rendering alone."
    return text.strip()


def head_numbers(means: Means) -> list[Number]:
    """Return the scores of `HEADS` that the result has."""
    out = []
    for label, *column, limit in HEADS:
        entry = found(means, *column)
        if entry:
            metric = METRICS[column[-1]]
            text = f"{entry['mean']:.{1 if metric.unit else metric.decimals}f}{' ' + metric.unit if metric.unit else ''}"
            photo = found(means, *column, "photo_as_albedo")
            none = "0 is none" + (f", the photographs have {photo['mean']:.{metric.decimals}f}" if photo else "")
            good = f"good from {LIMITS[limit].amber:g} {metric.unit}" if limit else none
            other = found(means, *column, "photo_mean")
            good += f"; the mean of the others has {other['mean']:.1f}" if other else ""
            out.append(Number(label, text, explanation_key(*column), good))
    return out


def explanations(means: Means) -> list[tuple[str, str, str]]:
    """Return the explanation of every score that any variant has."""
    columns = {
        (quantity, protocol, metric)
        for quantities in means.values()
        for quantity, protocols in quantities.items()
        for protocol, values in protocols.items()
        for metric in values
    }
    return [explain(*column) for column in sorted(columns)]


def explanation_key(quantity: str, protocol: str, metric: str) -> str:
    """Return the key of the explanation of a score."""
    return f"{quantity}-{protocol}-{metric}".replace("_", "-")


def explain(quantity: str, protocol: str, metric: str) -> tuple[str, str, str]:
    """Return key, term and words of a score: what is compared, how, and by which protocol."""
    what = {"rgb": "re-rendering of the photographs", "rgb_held_out": "re-rendering of held-out photographs"}.get(
        quantity, quantity
    )
    seen = quantity.startswith("rgb") and metric not in ("log_l2", "light_spread")
    against = "the photograph, in sensor values" if seen else "ground truth, pixel by pixel, linear"
    own = metric in ("shading_left", "shading_slope", "view_spread")
    measure = METRIC_WORDS.get(metric, METRICS[metric].label)
    words = (
        f"{measure}." if own else f"{measure}. Compared with {against}, {PROTOCOLS[protocol].explanation}; mean over the views."
    )
    return explanation_key(quantity, protocol, metric), f"{METRICS[metric].short} of {what}", words[0].upper() + words[1:]


def score_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return the tables of summary.json of stage metrics; those without any number are left out."""
    views = summary["views"]
    scored = "the views" if views["scored"] == views["of"] else f"{views['scored']} of the {views['of']} views, spread evenly"
    means = summary["means"]
    any_held_out = "rgb_held_out" in means.get("result", {})
    materials = [("albedo", "raw", m) for m in ("l2", "psnr", "ssim", "flip")]
    materials += [("albedo", "scaled", m) for m in ("l2", "psnr", "ssim")]
    materials += [(q, "raw", m) for q in ("roughness", "metallic") for m in ("l2", "psnr", "ssim")]
    oracle = [(q, "oracle_affine", m) for q in ("albedo", "roughness", "metallic") for m in ("l2", "psnr", "ssim")]
    light = [("rgb", "raw", m) for m in ("l2", "psnr", "ssim", "flip", "log_l2", "light_spread")] + [("rgb", "scaled", "log_l2")]
    light += [("emission", "raw", m) for m in ("l2", "log_l2", "iou")] + [("emission", "scaled", m) for m in ("l2", "log_l2")]
    tables = [
        score_table(
            f"Materials against ground truth, mean over {scored}",
            means,
            materials,
            "Linear values. Emitters, pixels without meaningful truth and (albedo) mirrors are left out, by the truth."
            " scaled = one gain per image and channel.",
        ),
        score_table(
            "Without truth",
            means,
            [("rgb_held_out", "raw", m) for m in ("l2", "psnr", "ssim", "flip")]
            + [("albedo", "raw", m) for m in ("shading_left", "shading_slope", "view_spread")],
            ("Held-out photographs: one exposure gain each where it is estimated. " if any_held_out else "")
            + "Shading left: correlation, inside objects, of log albedo with the log of the light that was found; 0 is none.",
        ),
        score_table("Light and re-rendering", means, light, "rgb: sensor values; its log L2: radiance, where known."),
        score_table(
            "With the best affine per image and object (an oracle)",
            means,
            oracle,
            "Every variant may correct each object by the truth; what remains is the error inside objects. Not a result.",
        ),
    ]
    return [table for table in tables if table]


def score_table(title: str, means: Means, columns: Sequence[tuple[str, str, str]], note: str = "") -> Table | None:
    """Tabulate variants x (quantity, protocol, metric); the best number of each column is marked where two variants have one.

    Args:
        title: title of the table.
        means: `means` of summary.json.
        columns: (quantity, protocol, metric) of every column; columns without any number are left out.
        note: text below the table.

    Returns:
        The table; None if no variant has any of the numbers.
    """
    variants = [v for v in VARIANT_NAMES if any(found(means, *column, v) for column in columns)]
    columns = [c for c in columns if any(found(means, *c, v) for v in variants)]
    if not variants:
        return None
    groups: list[tuple[str, int]] = []
    for quantity, protocol, _ in columns:
        text = quantity if protocol == "raw" else f"{quantity}, {protocol.replace('_', ' ')}"
        if groups and groups[-1][0] == text:
            groups[-1] = (text, groups[-1][1] + 1)
        else:
            groups.append((text, 1))
    best = set()
    for j, column in enumerate(columns):
        numbers = [(found(means, *column, v).get("mean"), i) for i, v in enumerate(variants)]
        present = [pair for pair in numbers if pair[0] is not None]
        if len(present) > 1:
            target = max(present)[0] if METRICS[column[2]].higher_is_better else min(present)[0]
            best |= {(i, j) for value, i in present if value == target}
    rows = [[VARIANT_NAMES[v], *(_text(found(means, *c, v).get("mean"), c[2]) for c in columns)] for v in variants]
    heads = [f"{METRICS[metric].short} {'↑' if METRICS[metric].higher_is_better else '↓'}" for _, _, metric in columns]
    explained = [explanation_key(*column) for column in columns]
    return Table(title, groups, heads, rows, frozenset(best), note, explained)


def _text(value: float | None, metric: str) -> str:
    if value is None:
        return "–"
    return f"{value:.{METRICS[metric].decimals}f}" if value < 1000 else f"{value:.3g}"
