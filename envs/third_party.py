# /// script
# requires-python = ">=3.11"
# dependencies = ["packaging==26.3", "cyclonedx-bom==7.5.0"]
# ///
"""Licences and bill of materials of everything that the locks name and that lies in the repository.

    uv run envs/third_party.py                   writes envs/licences.md (`make licences`)
    uv run envs/third_party.py --sbom sbom.json  writes a CycloneDX 1.6 document and checks it against its schema (`make sbom`)

Licences are what the packages declare: in .venv where it has the locked version, else in the wheel on the public index.
"""

from __future__ import annotations

import argparse
import email
import hashlib
import importlib.metadata
import io
import json
import re
import subprocess
import sys
import tarfile
import urllib.request
import zipfile
from pathlib import Path

import lock
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).resolve().parents[1]
PAGE = REPOSITORY / "envs" / "licences.md"
LOCKS = {
    "requirements.lock": "always",
    "torch.lock": "always",
    "torch-cuda.lock": "CUDA",
    "requirements-cluster.txt": "cluster",
    "docs.txt": "site",
}
SHIPPED = ("requirements.lock", "torch.lock", "torch-cuda.lock", "requirements-cluster.txt")  # of the bill of materials

READ = {
    "conda-inject": "MIT",
    "cuda-toolkit": "none declared (names the NVIDIA packages alone)",
    "openexr": "BSD-3-Clause",
    "snakemake-interface-common": "MIT",
    "snakemake-interface-logger-plugins": "MIT",
    "snakemake-interface-report-plugins": "MIT",
    "snakemake-interface-scheduler-plugins": "MIT",
    "snakemake-interface-storage-plugins": "MIT",
}
"""Licences that the metadata of a package does not declare, read in the file that it carries."""

MPL = "MPL 2.0: files of it that are changed and passed on stay under it"
NVIDIA = "proprietary: the terms of NVIDIA's CUDA EULA hold for use and for passing on"
NOTES = {
    "av": "the package is BSD, the FFmpeg in it reports LGPL 3 and links x264 and x265, both GPL 2 or later",
    "certifi": MPL,
    "docutils": "public domain and BSD; its mode for Emacs, which is not installed, is GPL 3",
    "hypothesis": MPL + "; only tests import it",
    "pi-heif": "the package is BSD, libheif and libde265 in it are LGPL 3, as shared libraries",
    "rawpy": "MIT; LibRaw in it LGPL 2.1 or CDDL 1.0, GCC's libgomp GPL 3 with the runtime exception, as shared libraries",
    "pycolmap": "carries GCC's libgfortran and libquadmath (GPL 3 with the runtime exception, LGPL 2.1), as shared libraries",
    "libusb-package": "the package is Apache 2.0, the libusb in it LGPL 2.1 or later, loaded as a shared library",
    "numpy": "carries GCC's libgfortran and libquadmath (GPL 3 with the runtime exception, LGPL 2.1), as shared libraries",
    "pathspec": MPL,
    "pulp": "carries the solver CBC, a separate program under EPL 2.0",
    "scipy": "carries GCC's libgfortran and libquadmath (GPL 3 with the runtime exception, LGPL 2.1), as shared libraries",
    "flip-evaluator": "carries GCC's libgomp (GPL 3 with the runtime exception); only tests import it",
    "torch": "carries GCC's libgomp (GPL 3 with the runtime exception)",
    "tqdm": MPL,
    "usd-core": "Tomorrow Open Source Technology licence 1.0: Apache 2.0 with another clause on trade marks",
    "cuda-toolkit": "a list of the NVIDIA packages below, whose terms hold",
}
PERMISSIVE = re.compile(
    r"MIT(-0|-CMU)?( License)?( \(MIT\)?)?|BSD.*|0BSD|Apache.*|ISC.*|PSF-2\.0|Python Software Foundation.*|Zlib|CC0-1\.0|BSL-1\.0"
    r"|CNRI-Python|Public Domain"
)

VENDORED = (
    ("three.js", "0.187.0", "MIT", "workflow/room/vendor/three.min.js"),
    ("LPIPS (weights of AlexNet)", "0.1", "BSD-3-Clause AND BSD-2-Clause", "workflow/models/weights/lpips_alex.npz"),
)
"""Name, version, licence, file in the repository."""


def metadata(name: str, version: str, file: str, installed: dict[str, importlib.metadata.Distribution]) -> email.message.Message:
    """Return the metadata of a locked package."""
    found = installed.get(name)
    if found is not None and found.version.partition("+")[0] == version:
        return found.metadata
    archive = lock.taken(name, lock.locked(file)[name], lock.ranks())
    if archive.name.endswith(".whl"):
        with zipfile.ZipFile(io.BufferedReader(lock.Remote(archive.address), 1 << 16)) as wheel:
            return email.message_from_bytes(wheel.read(next(n for n in wheel.namelist() if n.endswith(".dist-info/METADATA"))))
    with urllib.request.urlopen(archive.address, timeout=60) as answer, tarfile.open(fileobj=io.BytesIO(answer.read())) as source:
        return email.message_from_bytes(source.extractfile(next(n for n in source.getnames() if n.endswith("/PKG-INFO"))).read())


def licence(name: str, declared: email.message.Message) -> str:
    """Return the licence in one line: the SPDX expression, else the classifiers, else the first line of the old field."""
    classified = [c.rpartition(" :: ")[2] for c in declared.get_all("Classifier") or [] if c.startswith("License :: ")]
    classified = [c for c in classified if c != "OSI Approved"]
    first = (declared["License"] or "").strip().split("\n")[0]
    short = (
        first if first and first != "UNKNOWN" and len(first) < 40 and not first.startswith(("Copyright", "=", "Files")) else ""
    )
    return READ.get(name) or declared["License-Expression"] or short or ", ".join(sorted(classified))


def permissive(text: str) -> bool:
    parts = [part.strip(" ()") for part in re.split(r" AND | OR |, (?![Vv]ersion)", text)]
    return all(PERMISSIVE.fullmatch(re.sub(r"^The ", "", part)) for part in parts)


def packages() -> list[tuple[str, str, str, str]]:
    """Return (name, version, licence, where it is needed) of every locked package, by name."""
    folders = [str(path) for path in (REPOSITORY / ".venv").glob("lib/python*/site-packages")]
    installed = {str(canonicalize_name(d.name)): d for d in importlib.metadata.distributions(path=folders)}
    wanted: dict[tuple[str, str], tuple[str, str]] = {}
    for file, where in LOCKS.items():
        for name, version in re.findall(r"^([\w.-]+)==([^\s\\]+)", (REPOSITORY / "envs" / file).read_text(), re.MULTILINE):
            wanted.setdefault((str(canonicalize_name(name)), version), (file, where))

    def row(item):
        (name, version), (file, where) = item
        text = licence(name, metadata(name, version, file, installed))
        if not text:
            sys.exit(f"{name} {version} declares no licence: read its licence file and add it to READ in envs/third_party.py")
        if not permissive(text) and name not in NOTES and "NVIDIA" not in text and "Proprietary" not in text:
            sys.exit(f"{name} {version}: {text} is not known to be permissive: add a note to NOTES in envs/third_party.py")
        return name, version, text, where

    return sorted(lock.in_parallel(row, wanted.items()))


def vendored() -> list[tuple[str, str, str, str, str]]:
    """Return (name, version, licence, file, SHA-256)."""
    return [(*row, hashlib.sha256((REPOSITORY / row[-1]).read_bytes()).hexdigest()) for row in VENDORED]


def tables(page: str, found: list[tuple[str, str, str, str]]) -> str:
    """Return the page with the rows of its three tables made anew."""
    noted = [(name, NOTES.get(name, NVIDIA), where) for name, _, text, where in found if name in NOTES or not permissive(text)]
    files = [(name, version, text, f"`{file}` `{digest}`") for name, version, text, file, digest in vendored()]
    for first, rows in (("package | what", dict.fromkeys(noted)), ("what | version", files), ("package | version", found)):
        lines = "".join(f"| {' | '.join(row)} |\n" for row in rows)
        head = rf"(^\| {re.escape(first)} .*\n\|[-|]+\n)(?:\|.*\n)*"
        page, count = re.subn(head, lambda match, lines=lines: match[1] + lines, page, flags=re.MULTILINE)
        assert count == 1, first
    return page


def bill_of_materials(target: Path) -> None:
    """Write the CycloneDX document: the locks with their hashes, by cyclonedx-py, licences, and vendored files."""
    from cyclonedx.schema import SchemaVersion
    from cyclonedx.validation.json import JsonStrictValidator

    text = "".join((REPOSITORY / "envs" / file).read_text() + "\n" for file in SHIPPED[:3])
    known = set(re.findall(r"^([\w.-]+)==", text, re.MULTILINE))
    blocks = re.split(r"^(?=[a-z0-9])", (REPOSITORY / "envs" / SHIPPED[3]).read_text(), flags=re.MULTILINE)
    text += "".join(block for block in blocks if (name := re.match(r"([\w.-]+)==", block)) and name[1] not in known)
    command = [sys.executable, "-W", "ignore", "-m", "cyclonedx_py", "requirements", "--sv", "1.6", "--output-reproducible"]
    command += ["--pyproject", str(REPOSITORY / "pyproject.toml"), "-"]
    document = json.loads(subprocess.run(command, input=text, stdout=subprocess.PIPE, text=True, check=True).stdout)
    rows = re.findall(r"^\| ([\w.-]+) \| ([^|]+) \| ([^|]+) \| \w+ \|$", PAGE.read_text(), re.MULTILINE)
    licences = {(name, version): text for name, version, text in rows}
    for component in document["components"]:
        component.pop("description", None)  # the line of the lock once more
        try:
            declared = licences[str(canonicalize_name(component["name"])), component["version"]]
        except KeyError:
            sys.exit(f"{component['name']} {component['version']} is not in {PAGE.name}; run `make licences` first")
        component["licenses"] = [{"license": {"name": declared, "acknowledgement": "declared"}}]
    for name, version, text, file, digest in vendored():
        document["components"].append(
            {
                "type": "machine-learning-model" if file.endswith(".npz") else "library",
                "bom-ref": file,
                "name": name,
                "version": version,
                "hashes": [{"alg": "SHA-256", "content": digest}],
                "licenses": [{"expression": text, "acknowledgement": "declared"}],
            }
        )
    everything = json.dumps(document, indent=1) + "\n"
    if error := JsonStrictValidator(SchemaVersion.V1_6).validate_str(everything):
        sys.exit(f"not valid CycloneDX 1.6: {error}")
    target.write_text(everything)
    print(f"{target}: {len(document['components'])} components, valid CycloneDX 1.6", file=sys.stderr)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sbom", type=Path, help="write the bill of materials to this file instead")
    target = parser.parse_args().sbom
    if target:
        bill_of_materials(target)
    else:
        PAGE.write_text(tables(PAGE.read_text(), packages()))


if __name__ == "__main__":
    main()
