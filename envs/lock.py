# /// script
# requires-python = ">=3.11"
# dependencies = ["packaging==26.3"]
# ///
"""Second half of `make lock`: which builds of torch are accepted, and how much setup.sh will download.

    uv run envs/lock.py                     writes torch.lock, torch-cuda.lock and sizes.tsv from the public index
    uv run envs/lock.py --index <address>   adds the builds of torch of another index, or of a folder of wheels, to torch.lock

Sizes of what is unpacked are read from the tables of contents at the ends of the wheels; no wheel is downloaded.
"""

from __future__ import annotations

import argparse
import hashlib
import html.parser
import io
import json
import re
import subprocess
import sys
import urllib.parse
import urllib.request
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from packaging import tags
from packaging.utils import canonicalize_name, parse_wheel_filename

HERE = Path(__file__).resolve().parent
INDEX = "https://pypi.org/simple/"
PYTHONS = ("cp311", "cp312", "cp313", "cp314")
PLATFORMS = [f"manylinux_2_{minor}_x86_64" for minor in range(36, 4, -1)] + ["manylinux2014_x86_64", "linux_x86_64"]
FORMATS = "application/vnd.pypi.simple.v1+json, text/html;q=0.1"
MB = 1e6


@dataclass(frozen=True)
class Archive:
    """A wheel or source distribution: name, address, SHA-256 in hexadecimal, bytes, and bytes when unpacked (0: not known)."""

    name: str
    address: str
    sha256: str
    size: int = 0
    unpacked: int = 0


class Remote(io.RawIOBase):
    """The bytes of a file on a server, fetched range by range."""

    def __init__(self, address: str):
        self.address, self.place = address, 0
        with urllib.request.urlopen(urllib.request.Request(address, method="HEAD"), timeout=60) as answer:
            self.size = int(answer.headers["Content-Length"])

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def tell(self) -> int:
        return self.place

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self.place = offset + (0, self.place, self.size)[whence]
        return self.place

    def readinto(self, buffer) -> int:
        end = min(self.size, self.place + len(buffer))
        if end <= self.place:
            return 0
        request = urllib.request.Request(self.address, headers={"Range": f"bytes={self.place}-{end - 1}"})
        with urllib.request.urlopen(request, timeout=60) as answer:
            if answer.status != 206:
                raise OSError(f"{self.address}: the server sends whole files only")
            data = answer.read()
        buffer[: len(data)] = data
        self.place += len(data)
        return len(data)


class Links(html.parser.HTMLParser):
    """The addresses of an index page of HTML."""

    def __init__(self, page: str):
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag == "a":
            self.found += [value for name, value in attributes if name == "href" and value]


def archives(project: str, index: str = INDEX) -> list[Archive]:
    """Return everything that an index (address, or folder of wheels) has of a project."""
    if Path(index).is_dir():
        found = []
        for path in sorted(Path(index).resolve().glob(f"{project}-*.whl")):
            with path.open("rb") as file:
                found.append(Archive(path.name, str(path), hashlib.file_digest(file, "sha256").hexdigest()))
        return found
    page = f"{index.rstrip('/')}/{project}/"
    try:
        with urllib.request.urlopen(urllib.request.Request(page, headers={"Accept": FORMATS}), timeout=60) as answer:
            kind, base, text = answer.headers.get_content_type(), answer.url, answer.read().decode()
    except OSError as error:
        sys.exit(f"{page} cannot be read ({error}); name an index that has {project}, or a folder of wheels")
    if kind.endswith("json"):
        return [
            Archive(
                entry["filename"],
                urllib.parse.urljoin(base, entry["url"]),
                entry["hashes"].get("sha256", ""),
                entry.get("size", 0),
            )
            for entry in json.loads(text)["files"]
        ]
    found = []
    for link in Links(text).found:
        address, _, fragment = urllib.parse.urljoin(base, link).partition("#")
        sha256 = fragment.removeprefix("sha256=") if fragment.startswith("sha256=") else ""
        found.append(Archive(urllib.parse.unquote(address.rpartition("/")[2]), address, sha256))
    return found


def measured(archive: Archive) -> Archive:
    """Return the archive with its sizes; a source distribution counts as what it downloads."""
    if archive.name.endswith(".whl"):
        local = Path(archive.address)
        with local.open("rb") if local.is_file() else io.BufferedReader(Remote(archive.address), 1 << 16) as file:
            with zipfile.ZipFile(file) as wheel:
                unpacked = sum(entry.file_size for entry in wheel.infolist())
            size = file.seek(0, io.SEEK_END)
        return replace(archive, size=size, unpacked=unpacked)
    return replace(archive, unpacked=archive.size)


def in_parallel(function, items):
    with ThreadPoolExecutor(8) as pool:
        return list(pool.map(function, items))


# ------------------------------------------------------------------------------------------------------------ torch


def pinned_torch() -> str:
    return re.search(r"^torch==([^\s#]+)", (HERE / "requirements.in").read_text(), re.MULTILINE)[1]


def accepted_builds(version: str, index: str) -> list[Archive]:
    """Return the wheels of this version of torch, whatever its local suffix, for the Pythons that are supported."""
    pattern = re.compile(rf"torch-{re.escape(version)}(\+[\w.]+)?-({'|'.join(PYTHONS)})-\2-.*\.whl")
    found = [archive for archive in archives("torch", index) if pattern.fullmatch(archive.name)]
    if not found:
        sys.exit(f"{index} has no torch {version} for {', '.join(PYTHONS)}")
    for archive in found:
        if not re.fullmatch("[0-9a-f]{64}", archive.sha256):
            sys.exit(f"{index} gives no SHA-256 of {archive.name}; download it from there and name its folder as the index")
    return in_parallel(measured, found)


TORCH_HEAD = """\
# The builds of torch that setup.sh accepts, made by `make lock`; `make lock-torch INDEX=<address>` adds others. By hand:
# pip install --no-deps --require-hashes -r envs/torch.lock, for a CUDA build of the public index also -r envs/torch-cuda.lock
"""
BUILD = re.compile(r"#   ([0-9a-f]{64}) +(\d+) +(\d+) (\S+)")


def read_builds() -> list[Archive]:
    path = HERE / "torch.lock"
    found = [BUILD.fullmatch(line) for line in path.read_text().splitlines()] if path.is_file() else []
    return [Archive(row[4], "", row[1], int(row[2]), int(row[3])) for row in found if row]


def write_builds(version: str, builds: list[Archive]) -> None:
    builds = sorted(builds, key=lambda build: build.name)
    hashes = [f"    --hash=sha256:{sha256}" for sha256 in sorted({build.sha256 for build in builds})]
    rows = [f"#   {build.sha256} {build.size:>10} {build.unpacked:>10} {build.name}" for build in builds]
    requirement = " \\\n".join([f"torch=={version}", *hashes])
    columns = "# What these are: SHA-256, bytes to download, bytes on disk, file"
    (HERE / "torch.lock").write_text("\n".join([TORCH_HEAD + requirement, columns, *rows]) + "\n")


def add_builds(index: str) -> None:
    """Add, or bring up to date, the builds of torch of one index; those of other versions go."""
    version = pinned_torch()
    new = accepted_builds(version, index)
    names = {build.name for build in new}
    kept = [
        build for build in read_builds() if re.match(rf"torch-{re.escape(version)}[+-]", build.name) and build.name not in names
    ]
    write_builds(version, kept + new)
    print(f"torch.lock: {len(new)} builds of torch {version} from {index}, {len(kept)} others kept", file=sys.stderr)


def write_cuda() -> None:
    """Write what the CUDA builds of torch on the public index need beyond requirements.lock."""
    command = "uv pip compile --quiet --no-header --generate-hashes --python-version 3.11 --python-platform x86_64-manylinux_2_36"
    asked = f"torch=={pinned_torch()}\n"
    existing = HERE / "torch-cuda.lock"
    constraints = ["--constraint", str(HERE / "requirements.lock")]
    if existing.is_file() and f"# torch {pinned_torch()}:" in existing.read_text():  # another torch needs others
        constraints += ["--constraint", str(existing)]
    child = subprocess.run([*command.split(), *constraints, "-"], input=asked, capture_output=True, text=True, cwd=HERE)
    if child.returncode:
        sys.exit(child.stderr)
    elsewhere = {*locked("requirements.lock"), "torch"}
    blocks = re.split(r"^(?=[a-z0-9])", child.stdout, flags=re.MULTILINE)
    named = [(re.match(r"([\w.-]+)==", block), re.sub(r"\n    # .*", "", block)) for block in blocks]
    wanted = [block for name, block in named if name and canonicalize_name(name[1]) not in elsewhere]
    head = f"# torch {pinned_torch()}: what its CUDA builds for Linux need beyond requirements.lock, made by `make lock`\n"
    existing.write_text(head + "".join(wanted))


# ------------------------------------------------------------------------------------------------------------ sizes


def locked(file: str) -> dict[str, set[str]]:
    """Return the hashes of each package of a lock."""
    blocks = re.split(r"^(?=[A-Za-z0-9])", (HERE / file).read_text(), flags=re.MULTILINE)
    named = [(re.match(r"([\w.-]+)==", block), set(re.findall(r"sha256:([0-9a-f]{64})", block))) for block in blocks]
    return {str(canonicalize_name(name[1])): hashes for name, hashes in named if name}


def taken(name: str, hashes: set[str], ranks: dict[tags.Tag, int]) -> Archive:
    """Return what pip takes of a locked package on CPython 3.11 and x86-64 Linux: the best wheel, else the source."""

    def rank(archive: Archive) -> int:
        if not archive.name.endswith(".whl"):
            return len(ranks)
        return min((ranks[tag] for tag in parse_wheel_filename(archive.name)[3] if tag in ranks), default=len(ranks) + 1)

    return min((archive for archive in archives(name) if archive.sha256 in hashes), key=rank)


def ranks() -> dict[tags.Tag, int]:
    """Return the tags of wheels that CPython 3.11 on x86-64 Linux takes, 0 for the best."""
    known = [*tags.cpython_tags((3, 11), platforms=PLATFORMS), *tags.compatible_tags((3, 11), "cp311", PLATFORMS)]
    return {tag: rank for rank, tag in reversed(list(enumerate(known)))}


def write_sizes() -> None:
    known = ranks()
    rows = ["# What setup.sh downloads for CPython 3.11 on x86-64 Linux, made by `make lock`; torch itself: torch.lock"]
    rows.append("file\tpackages\tdownload_mb\tdisk_mb")
    for file in ("requirements.lock", "torch-cuda.lock"):
        found = in_parallel(lambda item: measured(taken(*item, known)), locked(file).items())
        sizes = [sum(archive.size for archive in found), sum(archive.unpacked for archive in found)]
        rows.append("\t".join([file, str(len(found)), *(str(round(size / MB)) for size in sizes)]))
    (HERE / "sizes.tsv").write_text("\n".join(rows) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--index", help="address of a package index, or a folder of wheels")
    index = parser.parse_args().index
    add_builds(index or INDEX)
    if not index:
        write_cuda()
        write_sizes()


if __name__ == "__main__":
    main()
