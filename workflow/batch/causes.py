"""Scenes that failed for the same cause, in one group: reasons that differ only in names, paths and numbers say the same."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

FEW = 10
"""Largest number of scenes that are listed one by one; of more, the causes are listed."""
ELLIPSIS = "…"
_ENDINGS = "exr|png|jpe?g|json|parquet|ply|obj|glb|yaml"
_EDGE = r"\s'\"`(),;:="
_VARIES = re.compile(rf"(?<!error )(?<![^{_EDGE}])[^{_EDGE}]*(?:[/\d][^\s'\"`(),;:]*|\.(?:{_ENDINGS})\b)", re.I)
"""Words that hold a slash, a digit or an ending of files: paths, names of views, numbers. Numbers of errors (`error 2`) stay."""
_SEEN = re.compile(r"[;:.]? ?(?:it|this process) had [\d,]+ MB when last seen", re.I)
_SEVERAL = re.compile(rf"{ELLIPSIS}(?:(?:, and | and | x | to |,? ){ELLIPSIS})+")

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Group:
    """Scenes that are not done for one cause, or of which a job failed for one cause although they are published.

    Attributes:
        status, stage: of all of them; the stage is empty for scenes that were refused.
        cause: the reason, without what differs between scenes.
        rows: the scenes in the order of the table, with `scene`, `status`, `stage` and `reason`.
    """

    status: str
    stage: str
    cause: str
    rows: tuple[Row, ...]

    @property
    def heading(self) -> str:
        """Count and state, such as `3 scenes failed in capture`."""
        count = f"{len(self.rows)} scene{'s' if len(self.rows) > 1 else ''}"
        return f"{count} {self.status}{f' in {self.stage}' if self.stage else ''}"


def cause_of(reason: str, scene: str) -> str:
    """Return the first line of a reason with an ellipsis for each path, name of a file, view or scene, and number.

    >>> cause_of("data/a-1/mesh.ply is 5590 m across; allowed: 1 to 300", "a-1")
    '… is … m across; allowed: …'
    """
    text = _SEEN.sub("", reason.strip().partition("\n")[0])
    anywhere = "" if scene.isalpha() else "?"  # a scene called `mesh` must not hide the word
    named = rf"(?<![\w-])((?:scene|of) ['\"]?){anywhere}{re.escape(scene)}(?![\w-])"
    text = re.sub(named, lambda found: f"{found[1] or ''}{ELLIPSIS}", text)
    return _SEVERAL.sub(ELLIPSIS, _VARIES.sub(ELLIPSIS, text))


def groups(rows: Iterable[Row]) -> list[Group]:
    """Return the scenes that have a reason by cause, the largest group first; equal ones in the order of the table.

    Args:
        rows: of the summary, also of scenes that are done.
    """
    found: dict[tuple[str, str, str], list[Row]] = {}
    for row in filter(_is_told, rows):
        key = row["status"], row["stage"] or "", cause_of(row["reason"] or "", row["scene"])
        found.setdefault(key, []).append(row)
    return [Group(*key, tuple(of)) for key, of in sorted(found.items(), key=lambda item: -len(item[1]))]


def lines(rows: Sequence[Row]) -> list[str]:
    """Return a line for each scene that has a reason; where there are more than `FEW`, one for each cause, with an example."""
    others = list(filter(_is_told, rows))
    if len(others) <= FEW:
        return [_line(row) for row in others]
    found = groups(others)
    out = [_told(group) for group in found[:FEW]]
    if rest := found[FEW:]:
        out.append(f"and {sum(len(group.rows) for group in rest)} scenes for {len(rest)} other causes")
    return out


def refusals(refused: Mapping[str, str]) -> list[str]:
    """Return the reasons of the scenes that cannot be run, or a line for each cause where there are more than `FEW` of them.

    Args:
        refused: scene -> reason.
    """
    if len(refused) <= FEW:
        return list(refused.values())
    return lines([{"scene": scene, "status": "refused", "stage": "", "reason": reason} for scene, reason in refused.items()])


def _is_told(row: Row) -> bool:
    return row["status"] != "done" or bool(row["reason"])


def _told(group: Group) -> str:
    first = group.rows[0]
    return f"{group.heading}, such as {first['scene']}: {first['reason']}" if len(group.rows) > 1 else _line(first)


def _line(row: Row) -> str:
    where = f" in {row['stage']}" if row["stage"] else ""
    return f"{row['scene']}: {row['status']}{where}: {row['reason']}"
