"""The files that a Mitsuba XML refers to, found without Mitsuba, so that they can be hashed and missing ones named."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from xml.parsers import expat

from iif_core.errors import InputError
from workflow.settings.names import did_you_mean_path

WHERE_FROM = (
    "Scenes from outside lie under data/ (a symbolic link is fine); the shipped ones are Benedikt Bitterli's rendering"
    " resources in Mitsuba form, with meshes/ and textures/ beside scene.xml"
)
_SHOWN = 8
_DEEPEST = 16  # <include> levels


def referenced_files(xml: Path) -> list[Path]:
    """List the scene's XML, the XML files that it includes and every file that they name; sorted, without repetition.

    `<default>` values are substituted in file names, and `<path>` folders are searched. The scene must have a sensor and a
    shape. This function runs while Snakemake plans and uses the standard library only.

    Raises:
        InputError: XML absent, not well-formed (with line and column) or not a scene; named files absent.
    """
    if not xml.is_file():
        raise InputError(f"{xml}: scene not found.{did_you_mean_path(xml)} {WHERE_FROM}")
    found: dict[Path, None] = {}
    missing: dict[str, None] = {}
    tags: set[str] = set()
    _collect(xml, [xml.parent], {}, found, missing, tags, 0)
    if missing:
        names = list(missing)
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        raise InputError(
            f"{xml}: names {len(names)} file(s) that are not there: {', '.join(names[:_SHOWN])}{more}."
            f" Looked in {xml.parent}. Put them beside the XML under these names. {WHERE_FROM}"
        )
    remedies = {"sensor": "add a <sensor> inside the room: the camera path starts there", "shape": "add surface"}
    for tag, remedy in remedies.items():
        if tag not in tags:
            raise InputError(f"{xml}: has no <{tag}>; {remedy}")
    return sorted(found)


def _collect(
    xml: Path,
    folders: list[Path],
    defaults: dict[str, str],
    found: dict[Path, None],
    missing: dict[str, None],
    tags: set[str],
    depth: int,
) -> None:
    try:
        root = ET.parse(xml).getroot()
    except ET.ParseError as error:
        line, column = error.position
        raise InputError(
            f"{xml}, line {line}, column {column + 1}: not well-formed XML ({expat.ErrorString(error.code)})."
            " Mend that line; `mitsuba` refuses the file too"
        ) from None
    except UnicodeDecodeError as error:
        raise InputError(f"{xml}: not text ({error}); expected a Mitsuba 3 scene") from None
    if depth == 0 and root.tag != "scene":
        raise InputError(f"{xml}: the outermost element is <{root.tag}>, expected <scene version='3.0.0'>")
    found[xml] = None
    folders = list(folders)
    for element in root.iter():
        tags.add(element.tag)
        if element.tag == "default":
            defaults.setdefault(element.get("name", ""), element.get("value", ""))
        elif element.tag == "path":
            folders.insert(0, xml.parent / _substitute(element.get("value", "."), defaults))
            continue
        name = element.get("filename")
        if element.tag == "string" and element.get("name") == "filename":
            name = element.get("value")
        if not name:
            continue
        name = _substitute(name, defaults)
        path = next((folder / name for folder in folders if (folder / name).is_file()), None)
        if path is None:
            missing[name] = None
        elif element.tag == "include":
            if depth >= _DEEPEST:
                raise InputError(f"{xml}: <include> goes {_DEEPEST} levels deep at {path}; does a file include itself?")
            _collect(path, folders, defaults, found, missing, tags, depth + 1)
        else:
            found[path] = None


def _substitute(text: str, defaults: dict[str, str]) -> str:
    """Replace every $name by its default, longest name first, as Mitsuba does."""
    for name in sorted(defaults, key=len, reverse=True):
        text = re.sub(re.escape("$" + name), lambda _, value=defaults[name]: value, text)
    return text
