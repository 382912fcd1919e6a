"""Which photographs a file of cameras lists, which of them are taken, what their views are called and where their files lie."""

from __future__ import annotations

import fnmatch
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.names import existing, fault_of_name, same_name, shown
from workflow.intake.pictures import EXTRAS, RAW
from workflow.intake.raws import DEVELOP
from workflow.sources.folder_scene import images

CONVERTERS = {
    **dict.fromkeys((".pef", ".srw", ".x3f", ".3fr", ".iiq", ".rwl"), DEVELOP),
    **dict.fromkeys((".gif", ".jxl", ".jp2"), "Convert all of them: mogrify -format png <files> (ImageMagick)"),
}
"""What to do with photographs of other formats."""


@dataclass(frozen=True)
class Entry:
    """One photograph as a file of cameras lists it, before anything about it is checked.

    Attributes:
        file_path: as written.
        where: names it in messages.
        keys: of its own, as in transforms.json: intrinsics, `transform_matrix`, depth.
        stated_name: of the view; None = the name of the file without extension.
        mask, mask_full, split, seen: as in `Frame`.
    """

    file_path: str
    where: str
    keys: dict[str, Any]
    stated_name: str | None = None
    mask: Path | None = None
    mask_full: bool = False
    split: str | None = None
    seen: np.ndarray | None = None

    @property
    def name(self) -> str:
        """Name of the view."""
        return self.stated_name or Path(self.file_path).stem


def evenly_spread(count: int, wanted: int) -> list[int]:
    """Return `wanted` of `count` indices, evenly spread, or all of them if there are fewer.

    >>> evenly_spread(10, 3)
    [1, 5, 8]
    """
    if count <= wanted:
        return list(range(count))
    return [int((i + 0.5) * count / wanted) for i in range(wanted)]


def choose_entries(entries: list[Entry], views: int) -> list[Entry]:
    """Return at most `views` entries, evenly spread; at most one in eight is a test photograph."""
    tests = [e for e in entries if e.split == "test"]
    others = [e for e in entries if e.split != "test"]
    if len(entries) > views:
        kept = min(len(tests), max(1, views // 8)) if views > 1 else 0
        tests = [tests[i] for i in evenly_spread(len(tests), kept)]
        others = [others[i] for i in evenly_spread(len(others), views - kept)]
    taken = {id(e) for e in (*others, *tests)}
    return [e for e in entries if id(e) in taken]


def notes_of_choice(taken: int, listed: int, pattern: str | None, views: int) -> tuple[str, ...]:
    """Say how many of the photographs that the camera file lists are used, if not all: `source.frames` and `capture.views`."""
    if taken == listed:
        return ()
    matching = f", of those that match `source.frames: {pattern}`" if pattern is not None else ""
    spread = f", evenly spread (`capture.views: {views}` is the most)" if taken == views else ""
    return (f"{taken} of the {listed} photographs in the list of cameras are used{matching}{spread}",)


def locate(
    path: Path, entries: list[Entry], root: Path, pattern: str | None, capture: dict[str, Any]
) -> list[tuple[Entry, Path]]:
    """Return the entries that `source.frames` (`pattern`) and `capture.views` choose, each with its photograph.

    Args:
        path: the file of cameras, which messages name.
        entries: one per photograph.
        root: folder that `file_path` counts from.
        pattern: of paths of files; None = all.
        capture: the dumped settings section.

    Raises:
        InputError: a photograph is absent (also one that is not taken), two views would have one name, all are for testing, or
            radiance and encoded values are mixed.
    """
    for entry in entries:
        if fault := fault_of_path(entry.file_path):
            raise InputError(f"{path}: {shown(entry.file_path)} {fault}")
    every = _told_apart(_matching(path, entries, pattern))
    found = {id(entry): _find_image(path, root, entry) for entry in every}
    chosen = choose_entries(every, capture["views"])
    if all(entry.split == "test" for entry in chosen):
        raise InputError(f"{path}: lists keep all {len(chosen)} photographs for testing; at least one must be there to use")
    _unique_names(path, chosen)
    _all_present(path, root, [image for image in found.values() if not image.is_file()])  # another quality takes others
    located = [(entry, found[id(entry)]) for entry in chosen]
    one_range(path, [image for _, image in located], capture["dynamic_range"])
    return located


def _matching(path: Path, entries: list[Entry], pattern: str | None) -> list[Entry]:
    if pattern is None:
        return entries
    kept = [e for e in entries if fnmatch.fnmatchcase(e.file_path, pattern)]
    if not kept:
        example = entries[0].file_path
        raise InputError(f"{path}: `source.frames: {pattern}` matches none of {len(entries)} frames (such as {example!r})")
    return kept


def fault_of_path(stated: Any) -> str:
    """Return why a path in a list of cameras names no file, or an empty text. Where it leads is left open: it is read alone."""
    if not isinstance(stated, str):
        return "is no text"
    if len(stated) > limits.TEXT:
        return f"has {len(stated)} characters (allowed {limits.TEXT})"
    *folders, name = Path(stated).parts or ("",)
    for part in folders:
        if fault := fault_of_name(part.lstrip("./") or "root", 255):
            return f"goes through no folder ({part!r:.40} {fault})"
    fault = fault_of_name(name)
    return f"names no file ({name!r:.40} {fault})" if fault else ""


def _told_apart(entries: list[Entry]) -> list[Entry]:
    """Name all views by folder and file where files of one name lie in several folders, as in rigs: `left_0000`, `right_0000`."""
    names = [same_name(entry.name) for entry in entries]
    files = {os.path.normpath(entry.file_path) for entry in entries}
    if len(set(names)) == len(names) or len(files) < len(entries) or any(entry.stated_name for entry in entries):
        return entries
    paths = [Path(entry.file_path).with_suffix("") for entry in entries]
    shared = len(os.path.commonprefix([path.parent.parts for path in paths]))
    longer = ["_".join(path.parts[shared:]) for path in paths]
    if len({same_name(name) for name in longer}) < len(longer):
        return entries
    return [replace(entry, stated_name=name) for entry, name in zip(entries, longer, strict=True)]


def _unique_names(path: Path, entries: list[Entry]) -> None:
    seen: dict[str, Entry] = {}
    for entry in entries:
        name = entry.name
        if fault := fault_of_name(name):
            raise InputError(f"{path}: {entry.where}: the name of a view {fault}; rename the photograph")
        other = seen.setdefault(same_name(name), entry)
        if other is entry:
            continue
        if _one_photograph(other.file_path, entry.file_path):
            raise InputError(
                f"{path}: {other.where} and {entry.where} are the same photograph, which is listed twice; remove one of"
                " the two frames"
            )
        if other.name != name:
            raise InputError(
                f"{path}: views {other.name!r} and {name!r} differ only in capital letters, which some disks ignore; rename"
                " one of the photographs"
            )
        raise InputError(
            f"{path}: {other.file_path!r} and {entry.file_path!r} would both be view {name!r}; file names without"
            " extension must differ: rename one, or select with `source.frames`"
        )


def _one_photograph(first: str, second: str) -> bool:
    """Return whether two file paths name one file; the extension may be left out."""
    a, b = Path(os.path.normpath(first)), Path(os.path.normpath(second))
    return a == b or (a.with_suffix("") == b.with_suffix("") and "" in (a.suffix, b.suffix))


def _find_image(path: Path, root: Path, entry: Entry) -> Path:
    stated = existing(root / entry.file_path)
    if stated.suffix.lower() in images.EXTENSIONS:
        return stated
    found = [c for c in (existing(stated.with_name(stated.name + e)) for e in images.EXTENSIONS) if c.is_file()]
    found = without_raws(found)
    if len(found) > 1:
        names = " and ".join(c.name for c in found)
        raise InputError(f"{path}: {entry.file_path!r} has no extension and {names} exist; name the one you mean")
    if not found and stated.is_file():
        allowed = ", ".join(images.EXTENSIONS)
        cure = CONVERTERS.get(stated.suffix.lower(), "Convert it")
        raise InputError(f"{stated}: not an image format that is read here; allowed: {allowed}. {cure}")
    return found[0] if found else stated


def without_raws(files: list[Path]) -> list[Path]:
    """Leave out raw files of which the developed photograph lies beside them, as cameras write both."""
    developed = {(path.parent, same_name(path.stem)) for path in files if path.suffix.lower() not in RAW}
    return [path for path in files if path.suffix.lower() not in RAW or (path.parent, same_name(path.stem)) not in developed]


def _all_present(path: Path, root: Path, missing: list[Path]) -> None:
    if missing:
        start = f"the folder of {path.name}" if path.parent == root else str(root)
        raise InputError(
            f"{path}: {len(missing)} image(s) not found: {some(missing)}."
            f" {'`file_path` counts' if path.suffix == '.json' else 'Names count'} from {start},"
            f" with extension ({', '.join(images.EXTENSIONS)}) or without.{_elsewhere(path, missing[0])}"
        )


def _elsewhere(path: Path, missing: Path) -> str:
    """Say in which folder beside the cameras a missing photograph lies, if it does."""
    wanted = same_name(missing.stem)
    for folder in sorted(own for own in path.parent.iterdir() if own.is_dir() and own.name not in EXTRAS):
        if any(same_name(file.stem) == wanted and file.suffix.lower() in images.EXTENSIONS for file in folder.iterdir()):
            cure = "write it before the names" if path.suffix == ".json" else f"set `source.images: {folder.name}`"
            return f" There is one in {folder.name}/: {cure}"
    return ""


def one_range(path: Path, files: list[Path], dynamic_range: str) -> None:
    raw = [f for f in files if f.suffix.lower() in RAW]
    if raw and len(raw) < len(files):
        other = next(f for f in files if f.suffix.lower() not in RAW)
        raise InputError(
            f"{path}: mixes raw files ({raw[0].name}), which are linear, and developed ones ({other.name}); choose with"
            " `source.frames`, or move one kind away"
        )
    hdr = [f for f in files if f.suffix.lower() == ".exr"]
    if hdr and len(hdr) < len(files):
        other = next(f for f in files if f.suffix.lower() != ".exr")
        raise InputError(f"{path}: mixes HDR ({hdr[0].name}) and LDR ({other.name}) images; choose with `source.frames`")
    if hdr and dynamic_range == "ldr":
        raise InputError(
            f"{path}: the images are EXR, which hold linear radiance, but `capture.dynamic_range` is ldr;"
            " set `capture: {dynamic_range: hdr}`"
        )
    if not hdr and dynamic_range == "hdr":
        raise InputError(
            f"{path}: `capture.dynamic_range` is hdr, but the images are {files[0].suffix.lower()};"
            " set `capture: {dynamic_range: ldr}` or give linear EXR images"
        )


def some(paths: list[Any], most: int = 3) -> str:
    """Name the first few of a list, and say how many more there are."""
    names = ", ".join(str(p) for p in paths[:most])
    return names + (f" and {len(paths) - most} more" if len(paths) > most else "")
