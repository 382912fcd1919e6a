"""The tables of lab/notebook/stability.md, made from the rows of the study."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from workflow.report.blocks import markdown

if TYPE_CHECKING:
    import pandas as pd

_FORMS = ("numpy float32", "numpy float64", "torch float32", "drjit float32", "numba float32")


def tables(frame: pd.DataFrame) -> dict[str, str]:
    """Return the tables in Markdown by name: `measured`, `verdict`, and one for each part.

    Args:
        frame: rows of all parts (`lab.stability.rows.COLUMNS`).
    """
    made = {
        "measured": _measured,
        "verdict": _verdict,
        "kernels": _kernels,
        "solvers": _solvers,
        "sums": _sums,
        "orders": _orders,
        "relations": _relations,
        "digits": _digits,
        "flips": _flips,
        "samplers": _samplers,
        "renderings": _renderings,
        "caches": _caches,
        "extremes": _extremes,
        "sensitivity": _sensitivity,
    }
    return {name: "\n".join(make(frame)) for name, make in made.items()}


def whole(frame: pd.DataFrame) -> str:
    """Return a page of all tables."""
    return "\n".join(f"## {name.capitalize()}\n\n{table}\n" for name, table in tables(frame).items())


def _number(value: float) -> str:
    if math.isnan(value):
        return ""
    if math.isinf(value):
        return "∞"
    if value == 0 or 0.1 <= abs(value) < 1e4:
        return f"{value:.3g}" if value != int(value) or abs(value) < 1 else f"{value:.0f}"
    return f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e").replace("e+", "e")


def _measured(frame: pd.DataFrame) -> list[str]:
    rows = frame[frame["part"] == "measured"]
    return markdown(
        ["part", "commit", "machine", "seconds"],
        [[r.subject, r.form, r.case, f"{r.value:.0f}"] for r in rows.itertuples()],
        3,
    )


def _verdict(frame: pd.DataFrame) -> list[str]:
    body = []
    for part, rows in frame[frame["part"] != "measured"].groupby("part", sort=False):
        judged = rows[rows["limit"] < math.inf]
        guarded = rows[rows["says"].ne("") & rows["quantity"].eq("backward error / eps") & rows["limit"].isna()]
        forms = rows.groupby(["subject", "form"]).ngroups
        body.append([str(part), str(forms), str(len(judged)), str(int((~judged["in_order"]).sum())), str(len(guarded))])
    return markdown(["part", "subjects x forms", "figures with a limit", "above it", "known limits, with a guard"], body)


def _kernels(frame: pd.DataFrame) -> list[str]:
    own = frame[frame["part"] == "kernels"]
    body = []
    for kernel, rows in own.groupby("subject", sort=False):
        ratio = rows[rows["quantity"] == "ratio"].groupby("form")["value"].max()
        ulp = rows[rows["quantity"] == "largest error / ulp"].groupby("form")["value"].max()
        median = rows[rows["quantity"] == "median error / ulp"]["value"].max()
        lost = rows[rows["quantity"] == "lost"]["value"].sum()
        cells = [f"{_number(ratio[form])} ({_number(ulp[form])})" if form in ratio else "" for form in _FORMS]
        body.append([str(kernel), *cells, _number(median), _number(lost)])
    return markdown(["kernel", *_FORMS, "largest median", "lost"], body)


def _solvers(frame: pd.DataFrame) -> list[str]:
    own = frame[frame["part"] == "solvers"]
    body = []
    for (solver, case), rows in own.groupby(["subject", "case"], sort=False):
        value = rows.set_index("quantity")["value"]
        names = ("size", "condition", "backward error / eps", "forward error", "growth")
        says = " ".join(dict.fromkeys(text for text in rows["says"] if text))
        body.append([str(solver), str(case), *(_number(value[name]) for name in names), _number(value["lost"]), says])
    head = ["solver", "matrix", "size", "condition", "backward error / eps", "forward error", "growth", "lost", "what it does"]
    return markdown(head, body, 2)


def _sums(frame: pd.DataFrame) -> list[str]:
    own = frame[frame["part"] == "sums"]
    kinds = list(dict.fromkeys(own["case"]))
    body = []
    for way, rows in own.groupby("subject", sort=False):
        error = rows[rows["quantity"] == "error / eps"].set_index("case")
        count = rows[rows["quantity"] == "terms"]["value"].max()
        cells = [_number(error.loc[kind, "value"]) for kind in kinds]
        body.append([str(way), str(rows["form"].iloc[0]), _number(count), *cells, _number(error["limit"].max())])
    return markdown(["sum", "accumulator", "terms", *kinds, "bound"], body, 2)


def _orders(frame: pd.DataFrame) -> list[str]:
    own = frame[frame["part"] == "orders"]
    same = {True: "the same bytes", False: ""}
    body = [[r.subject, r.case, same[r.value == 0] or _number(r.value), _number(r.limit)] for r in own.itertuples()]
    return markdown(["result", "changed", "largest difference", "allowed"], body, 2)


def _relations(frame: pd.DataFrame) -> list[str]:
    own = frame[frame["part"] == "relations"]
    names = list(dict.fromkeys(own["quantity"]))
    body = []
    for (room, form, case), rows in own.groupby(["subject", "form", "case"], sort=False):
        found = rows.set_index("quantity")
        cells = [
            _number(found.loc[name, "value"]) if found.loc[name, "in_order"] else f"**{_number(found.loc[name, 'value'])}**"
            for name in names
        ]
        says = next((text for text in rows["says"] if text), "")
        body.append([str(room), str(case), str(form), *cells, says])
    return markdown(["room", "changed", "yardstick", *names, "why"], body, 3)


def _digits(frame: pd.DataFrame) -> list[str]:
    own = frame[(frame["part"] == "digits") & ~frame["quantity"].isin(["flips", "of"])]
    names = list(dict.fromkeys(own["quantity"]))
    body = []
    for (room, form, case), rows in own.groupby(["subject", "form", "case"], sort=False):
        value = rows.set_index("quantity")["value"]
        share = [f"{100 * value[name]:.1f} %" if name.startswith("share") else _number(value[name]) for name in names]
        body.append([str(room), str(form), str(case), *share])
    return markdown(["room", "moved", "output", *names], body, 3)


def _flips(frame: pd.DataFrame) -> list[str]:
    own = frame[(frame["part"] == "digits") & frame["quantity"].isin(["flips", "of"])]
    body = []
    for (room, form, case), rows in own.groupby(["subject", "form", "case"], sort=False):
        value = rows.set_index("quantity")["value"]
        body.append([str(room), str(form), str(case), f"{value['flips']:.0f}", f"{value['of']:.0f}"])
    return markdown(["room", "moved", "decision", "otherwise", "of"], body, 3)


def _renderings(frame: pd.DataFrame) -> list[str]:
    own = frame[frame["part"] == "renderings"]
    names = list(dict.fromkeys(own["quantity"]))
    body = []
    for room, rows in own.groupby("subject", sort=False):
        value = rows.set_index("quantity")["value"]
        body.append([str(room), *(_number(value[name]) for name in names)])
    return markdown(["room", *names], body)


def _samplers(frame: pd.DataFrame) -> list[str]:
    own = frame[frame["part"] == "samplers"]
    body = []
    for (sampler, form), rows in own.groupby(["subject", "form"], sort=False):
        value = {name: part["value"] for name, part in rows.groupby("quantity")}
        mean, worst = value["statistic / freedom"].mean(), value["threshold / p"].max()
        count, cells, draws = len(value["draws"]), value["cells"].max(), value["draws"].max()
        body.append([str(sampler), str(form), str(count), *(_number(x) for x in (draws, cells, mean, worst))])
    return markdown(
        ["what is drawn", "form", "tests", "draws", "cells", "mean statistic / freedom", "largest threshold / p"], body, 2
    )


def _caches(frame: pd.DataFrame) -> list[str]:
    own = frame[frame["part"] == "caches"]
    names = list(dict.fromkeys(own["quantity"]))
    body = []
    for (room, form, case), rows in own.groupby(["subject", "form", "case"], sort=False):
        value = rows.set_index("quantity")["value"]
        body.append([str(room), str(form), str(case), *(_number(value[name]) for name in names)])
    return markdown(["room", "cache", "paths", *names], body, 3)


def _extremes(frame: pd.DataFrame) -> list[str]:
    own = frame[frame["part"] == "extremes"]
    names = ["albedo", "albedo_as_is", "roughness", "metallic", "light", "lost", "seconds"]
    rooms = list(dict.fromkeys(own["subject"]))
    body = []
    for case, rows in own.groupby("case", sort=False):
        for room in rooms:
            one = rows[rows["subject"] == room]
            if not len(one):
                continue
            value = one.set_index("quantity")["value"]
            says = next((text for text in one["says"] if text), "")
            body.append([str(case), str(room), *(_number(value[name]) if name in value else "" for name in names), says])
    head = ["extreme", "room", "albedo, dB", "as it is, dB", "roughness", "metallic", "log light", "lost", "seconds", "message"]
    return markdown(head, body, 2)


def ranked(frame: pd.DataFrame, room: str, score: str) -> list[tuple[str, str, float, float, float]]:
    """Return (factor, levels, effect, size, error) of a room and a score, the largest size first."""
    own = frame[(frame["part"] == "sensitivity") & (frame["subject"] == room)]
    out = []
    for (case, levels), rows in own.groupby(["case", "form"], sort=False):
        value = rows.set_index("quantity")["value"]
        numbers = [float(value[f"{score}: {name}"]) for name in ("effect", "size", "error")]
        out.append((str(case), str(levels), numbers[0], numbers[1], numbers[2]))
    return sorted(out, key=lambda row: -row[3])


def _sensitivity(frame: pd.DataFrame) -> list[str]:
    own = frame[frame["part"] == "sensitivity"]
    rooms, scores = list(dict.fromkeys(own["subject"])), ("albedo", "albedo_as_is", "roughness", "light")
    found = {(room, score): {row[0]: row for row in ranked(frame, room, score)} for room in rooms for score in scores}
    body = []
    for factor, levels, *_ in ranked(frame, rooms[-1], "albedo") if rooms else []:
        cells = []
        for room in rooms:
            for score in scores:
                _, _, effect, size, error = found[room, score][factor]
                text = f"{effect:+.2f} ({size:.2f} ± {error:.2f})"
                cells.append(f"**{text}**" if size > error and size > 0.05 else text)
        body.append([factor, levels, *cells])
    head = ["factor", "levels", *(f"{room}: {score.replace('_', ' ')}" for room in rooms for score in scores)]
    return markdown(head, body, 2)
