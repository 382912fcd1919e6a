"""The files that a Mitsuba XML refers to, found without Mitsuba, so that they can be hashed and missing ones named."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

from iif_core.errors import InputError
from workflow.intake import limits
from workflow.intake.documents import check_file, reading
from workflow.intake.names import shown
from workflow.settings.names import did_you_mean_path

WHERE_FROM = (
    "Scenes from outside lie under data/ (a symbolic link is fine); the shipped ones are Benedikt Bitterli's rendering"
    " resources in Mitsuba form, with meshes/ and textures/ next to scene.xml"
)
XML_BYTES = 16 << 20
"""Size of a Mitsuba XML file, at most. The largest scene in use has 0.6 MB."""
XML_ELEMENTS = 200_000
"""Elements of the XML files of a scene, at most."""
XML_FILES = 256
"""XML files of a scene, at most."""
XML_DEFAULTS = 1_000
"""`<default>` values of a scene, at most."""
XML_DEPTH = 64
"""Levels of elements in a Mitsuba XML file, at most."""
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
    _Search(found, missing, tags).collect(xml, [xml.parent], {}, 0)
    if missing:
        names = list(missing)
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        raise InputError(
            f"{xml}: names {len(names)} file(s) that are not there: {', '.join(names[:_SHOWN])}{more}."
            f" Looked in {xml.parent}. Put them next to the XML under these names. {WHERE_FROM}"
        )
    remedies = {"sensor": "add a <sensor> inside the room: the camera path starts there", "shape": "add surface"}
    for tag, remedy in remedies.items():
        if tag not in tags:
            raise InputError(f"{xml}: has no <{tag}>; {remedy}")
    return sorted(found)


@dataclass
class _Search:
    """What is found in the XML files of a scene: files, names of missing ones, tags; and how many elements there are."""

    found: dict[Path, None]
    missing: dict[str, None]
    tags: set[str]
    elements: int = 0
    documents: int = 0

    def collect(self, xml: Path, folders: list[Path], defaults: dict[str, str], depth: int) -> None:
        """Add what one XML file names, and what the files name that it includes."""
        self.documents += 1
        if self.documents > XML_FILES:
            raise InputError(f"{xml}: more than {XML_FILES} XML files with all that are included; does a file include itself?")
        root = _root(xml)
        if depth == 0 and root.tag != "scene":
            raise InputError(f"{xml}: the outermost element is <{root.tag:.40}>, expected <scene version='3.0.0'>")
        self.found[xml] = None
        folders = list(folders)
        for element in root.iter():
            self.elements += 1
            if self.elements > XML_ELEMENTS or len(defaults) > XML_DEFAULTS:
                raise InputError(
                    f"{xml}: more than {XML_ELEMENTS} elements, or {XML_DEFAULTS} <default> values, with what is included"
                )
            self.tags.add(element.tag)
            if element.tag == "default":
                defaults.setdefault(element.get("name", ""), element.get("value", ""))
            elif element.tag == "path":
                folders.insert(0, xml.parent / _substitute(xml, element.get("value", "."), defaults))
                continue
            name = element.get("filename")
            if element.tag == "string" and element.get("name") == "filename":
                name = element.get("value")
            if not name:
                continue
            name = _substitute(xml, name, defaults)
            with reading(xml, f"the file name {shown(name)} cannot be used"):
                path = next((folder / name for folder in folders if (folder / name).is_file()), None)
            if path is None:
                self.missing[name] = None
            elif element.tag == "include":
                if depth >= _DEEPEST:
                    raise InputError(f"{xml}: <include> goes {_DEEPEST} levels deep at {path}; does a file include itself?")
                self.collect(path, folders, defaults, depth + 1)
            else:
                self.found[path] = None


def _root(xml: Path) -> ET.Element:
    """Return the outermost element of an XML file, after checking how deep its elements are nested."""
    check_file(xml, XML_BYTES, "a Mitsuba scene")
    depth, root = 0, None
    try:
        for event, element in ET.iterparse(xml, ("start", "end")):
            root = element if root is None else root
            depth += 1 if event == "start" else -1
            if depth > XML_DEPTH:
                raise InputError(f"{xml}: elements are nested more than {XML_DEPTH} levels deep")
    except ET.ParseError as error:
        line, column = error.position
        raise InputError(
            f"{xml}, line {line}, column {column + 1}: not well-formed XML ({expat.ErrorString(error.code)})."
            " Mend that line; `mitsuba` refuses the file too"
        ) from None
    except InputError:
        raise
    except (ValueError, LookupError, OSError) as error:  # an encoding that is unknown, or bytes that are none of its letters
        raise InputError(f"{xml}: not text ({error}); expected a Mitsuba 3 scene") from None
    if root is None:
        raise InputError(f"{xml}: empty; expected a Mitsuba 3 scene")
    return root


def _substitute(xml: Path, text: str, defaults: dict[str, str]) -> str:
    """Replace every $name by its default, longest name first, as Mitsuba does."""
    for name in sorted(defaults, key=len, reverse=True) if "$" in text else ():
        text = text.replace("$" + name, defaults[name])
        if len(text) > limits.TEXT:
            break
    if len(text) > limits.TEXT:
        raise InputError(f"{xml}: a file name has more than {limits.TEXT} characters ({shown(text)})")
    return text
