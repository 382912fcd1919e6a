"""config/batch.tsv: one scene per line, run together by `snakemake scenes` (docs/guide/batch.md).

Mistakes about which scenes there are (encoding, header, cells, names) stop the run before any job, all in one message. A mistake
in one scene (its base, settings, data) refuses that scene alone, with the reason. Nothing heavy is imported here.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import read_bytes
from workflow.intake.names import fault_of_name, shown
from workflow.settings.names import RESERVED, SCENE_NAME, configuration, did_you_mean, scene_names, scene_path
from workflow.settings.yaml_file import parse_yaml, read_yaml

TABLE = Path("config/batch.tsv")
QUALITY = "config/quality/"
"""Where files of settings lie that a user names and does not write."""
COLUMNS = ("name", "source", "path", "base", "overrides")
_NAME = re.compile(SCENE_NAME)
_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*")
_SHOWN = 20  # problems in one message


@dataclass(frozen=True)
class Line:
    """One line of the table, with its cells stripped; `number` counts from 1 and includes the header and comments."""

    number: int
    name: str
    source: str = ""
    path: str = ""
    base: str = ""
    overrides: str = ""

    def at(self, column: str = "") -> str:
        """Return the place in the table: `config/batch.tsv, line 7, column overrides`."""
        return f"{TABLE}, line {self.number}" + (f", column {column}" if column else "")

    @property
    def is_plain(self) -> bool:
        """Whether the line has only a name: it then means config/scenes/<name>.yaml unchanged."""
        return not (self.source or self.path or self.base or self.overrides)


# ---------------------------------------------------------------------------------------------------------------- table


def read_table(root: Path = Path(".")) -> tuple[Line, ...]:
    """Return the lines of the table; without a table, every scene that has a file (with `number` 0).

    Raises:
        InputError: names every mistake about which scenes there are, with line and column.
    """
    table = _of(root)
    if table is None:
        return tuple(Line(0, name) for name in scene_names(root))
    problems = [said for _, said in table.problems]
    if not problems and not table.lines:
        problems = [f"{TABLE}: no scene in it; write the header line {' <tab> '.join(COLUMNS)} and below it a line a scene"]
    if problems:
        more = f"\n... and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
        raise InputError("\n".join(problems[:_SHOWN]) + more)
    return tuple(table.lines.values())


@dataclass(frozen=True)
class _Table:
    """Lines without mistakes, by name, and of the others (name, what is wrong), in the order of the file."""

    lines: dict[str, Line]
    problems: tuple[tuple[str, str], ...]


def _of(root: Path) -> _Table | None:
    """Return what the table holds, right and wrong; None without a table."""
    path = _table(root)
    if not path.is_file():
        return None
    status = path.stat()
    return _read_table(path, (status.st_size, status.st_mtime_ns))


def _table(root: Path) -> Path:
    """The table that belongs to the scenes of the working folder (or, where it has none, to those of the repository)."""
    return configuration("scenes", root).with_name(TABLE.name)


@lru_cache(8)
def _read_table(path: Path, _stamp: tuple[int, int]) -> _Table:
    problems: list[tuple[str, str]] = []
    header: list[str] = []
    lines: dict[str, Line] = {}
    for number, text in enumerate(_text_of(path).split("\n"), 1):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        cells = [cell.strip() for cell in text.split("\t")]
        if not header:
            _check_header(cells, number, text)
            header = cells
            continue
        problem = _problem_of_cells(cells, header, text)
        line = Line(number, **dict(zip(header, cells, strict=False)))
        problem = problem or _problem_of_name(line, lines) or _problem_of_file(line, path.parent / "scenes")
        if problem:
            problems.append((line.name, f"{TABLE}, line {number}{problem}"))
        else:
            lines[line.name] = line
    return _Table(lines, tuple(problems))


def _text_of(path: Path) -> str:
    """Return the text of a UTF-8 file, with or without byte order mark, with any of the usual line ends."""
    data = read_bytes(path, limits.TABLE_BYTES, "the table of scenes")
    if b"\0" in data:
        raise InputError(f"{TABLE}: holds zero bytes (UTF-16, or no text at all); save it as UTF-8, columns separated by tabs")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        number = data[: error.start].count(b"\n") + 1
        raise InputError(f"{TABLE}, line {number}: not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _check_header(cells: list[str], number: int, text: str) -> None:
    where = f"{TABLE}, line {number}"
    if other := _instead_of_tabs(text):
        raise InputError(
            f"{where}: the header has one column, {shown(text.strip())}; columns are separated by tabs, not by {other}"
        )
    for i, cell in enumerate(cells):
        if cell not in COLUMNS:
            hint = did_you_mean(cell, COLUMNS)
            raise InputError(f"{where}: column {i + 1} is called {shown(cell)}.{hint} Allowed: {', '.join(COLUMNS)}")
        if cell in cells[:i]:
            raise InputError(f"{where}: column {cell} stands twice; remove one")
    if "name" not in cells:
        raise InputError(f"{where}: no column name; allowed: {', '.join(COLUMNS)}")


def _problem_of_cells(cells: list[str], header: list[str], text: str) -> str:
    if len(cells) > len(header):
        return (
            f", column {len(header) + 1}: found {len(cells)} cells, the header has {len(header)} columns"
            f" ({', '.join(header)}); remove {shown(cells[len(header)])} or a tab before it"
        )
    if other := _instead_of_tabs(text):
        return f", column name: found {shown(text.strip())}; cells are separated by tabs, this line has {other}"
    return ""


def _instead_of_tabs(text: str) -> str:
    """Name what a line has instead of tabs; empty if it has tabs, or only one word."""
    if "\t" in text:
        return ""
    found = next((name for sign, name in ((",", "commas"), (";", "semicolons")) if sign in text), "")
    return found or ("spaces" if len(text.split()) > 1 else "")


def _problem_of_name(line: Line, earlier: dict[str, Line]) -> str:
    where, name = ", column name: ", line.name
    if not name:
        return where + "empty; every scene needs a name"
    if not _NAME.fullmatch(name) or "--" in name or fault_of_name(name):
        return where + f"found {shown(name)}; use letters, digits, _ and single -, starting with a letter or digit"
    if name in RESERVED:
        return where + f"found {name!r}, which results/ uses otherwise; choose another name"
    if name in earlier:
        return where + f"{name!r} stands in line {earlier[name].number} already; names must differ"
    return ""


def _problem_of_file(line: Line, folder: Path) -> str:
    if line.is_plain or not (folder / f"{line.name}.yaml").is_file():
        return ""
    return (
        f", column name: config/scenes/{line.name}.yaml is there already; leave the other cells empty to run it as it is,"
        f" or take another name and write {line.name} into column base"
    )


# -------------------------------------------------------------------------------------------------------- one scene


def find(name: str, root: Path = Path(".")) -> Line | None:
    """Return the line that describes a scene; None for a scene with its own file, of a study, or not in the table.

    Mistakes in other lines do not count, so that the jobs of a run continue while somebody edits the table.

    Raises:
        InputError: a mistake in the lines of this scene, or the whole table cannot be read.
    """
    table = None if "--" in name or scene_path(name, root).is_file() else _of(root)
    if table is None:
        return None
    if own := [said for of, said in table.problems if of == name]:
        raise InputError("\n".join(own))
    line = table.lines.get(name)
    return line if line and not line.is_plain else None


def layers(line: Line, root: Path = Path(".")) -> list[tuple[str, dict[str, Any]]]:
    """Return (place, settings) of the layers of a line, lowest first: its base, its columns, its overrides.

    Raises:
        InputError: there is no such base, or the overrides cannot be read.
    """
    out: list[tuple[str, dict[str, Any]]] = []
    if line.base:
        out.append(_base(line, root))
    if line.source:
        out.append((line.at("source"), {"source": {"kind": line.source}}))
    if line.path:
        out.append((line.at("path"), {"source": {"path": line.path}}))
    if line.overrides:
        out.append((line.at("overrides"), parse_overrides(line.overrides, line.at("overrides"))))
    return out


def blame(line: Line, among: list[tuple[str, dict[str, Any]]]) -> Callable[[str], str]:
    """Return a function that tells where the value of a dotted key comes from: the layer that names most of it, the upper one
    of two. A quality is named only for keys that it sets itself: what is missing is missing in the table."""

    def where(dotted: str) -> str:
        best, found = line.at(), 0
        for name, layer in among:
            depth, node = 0, layer
            for part in dotted.split("."):
                if not isinstance(node, dict) or part not in node:
                    break
                depth, node = depth + 1, node[part]
            whole = depth == dotted.count(".") + 1
            if depth and depth >= found and (whole or not name.startswith(QUALITY)):
                best, found = name, depth
        missing = dotted == "source.path" and found < 2
        return line.at("path") if missing else best

    return where


def _base(line: Line, root: Path) -> tuple[str, dict[str, Any]]:
    name = Path(line.base).stem if line.base.startswith("config/scenes/") else line.base
    path = scene_path(name, root)
    if fault_of_name(name) or not path.is_file():
        names = scene_names(root)
        known = f"{did_you_mean(name, names)} Known: {', '.join(names) or 'none'}."
        raise InputError(f"{line.at('base')}: config/scenes/{name:.80}.yaml not found.{known}")
    return f"config/scenes/{name}.yaml (base of {line.at()})", _read_base(path, path.stat().st_mtime_ns)


@lru_cache(8)
def _read_base(path: Path, _stamp: int) -> dict[str, Any]:
    return read_yaml(path)  # hundreds of lines share one base


def parse_overrides(text: str, where: str = "overrides") -> dict[str, Any]:
    """Return `capture.views=24;prior.samples=8` as a tree; values are YAML, and `;` always ends a value.

    Raises:
        InputError: the message begins with `where` and names the entry.
    """
    out: dict[str, Any] = {}
    seen: list[str] = []
    for entry in filter(None, (part.strip() for part in text.split(";"))):
        key, sign, value = (part.strip() for part in entry.partition("="))
        if not sign or not value or not _KEY.fullmatch(key):
            raise InputError(
                f"{where}: found {shown(entry)}, needed key=value with a dotted key, such as capture.views=24;prior.samples=8"
            )
        if key in ("source.kind", "source.path"):
            raise InputError(f"{where}: {key!r} has its own column, {'source' if key.endswith('kind') else 'path'}")
        for other in seen:
            if key == other:
                raise InputError(f"{where}: {key!r} stands twice")
            if key.startswith(other + ".") or other.startswith(key + "."):
                raise InputError(f"{where}: {other!r} and {key!r} set the same thing; keep one")
        seen.append(key)
        try:
            parsed = parse_yaml(value)
        except yaml.YAMLError as error:
            raise InputError(
                f"{where}: {key!r}: {shown(value)} is not a YAML value ({getattr(error, 'problem', None) or error})"
            ) from None
        *parents, leaf = key.split(".")
        node = out
        for part in parents:
            node = node.setdefault(part, {})
        node[leaf] = parsed
    return out
