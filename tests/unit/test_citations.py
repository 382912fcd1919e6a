"""Everything that code, tests and documents cite exists: equations, pages, headings, and relative links."""

from __future__ import annotations

import re
import subprocess
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EQUATION = re.compile(r"\bEqs?\. ([A-Z])\.(\d+[a-z]?)(?:(?:, | and | to |-)(?:([A-Z])\.)?(\d+[a-z]?))*")
NUMBER = re.compile(r"\b([A-Z])\.(\d+[a-z]?)\b")
PAGE = re.compile(r"(?<![\w/.-])(?:docs|lab/notebook|lab/docs)/[\w/-]+\.md(?:#[\w-]+)?")
LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)|!\[[^\]]*\]\(([^)\s]+)\)")
UNSHIPPED = re.compile(r"\b[A-Z]{6,} (?:\d+\.\d+|H\d+)\b|\bH\d{1,2}\b")  # sections of papers in capitals, numbered hazards
PAGE_OF_LETTER = {
    "R": "reflectance",
    "C": "camera",
    "D": "reconstruction",
    "P": "priors",
    "N": "plan",
    "O": "objects",
    "F": "fusion",
    "L": "light",
    "S": "shading",
    "M": "fitting",
    "E": "evaluation",
}


def tracked(*patterns: str) -> list[Path]:
    """Files that git tracks or would add, as they are in the working tree."""
    listed = subprocess.check_output(["git", "ls-files", "-co", "--exclude-standard", *patterns], cwd=ROOT, text=True)
    return [ROOT / name for name in listed.split("\n") if name and (ROOT / name).is_file()]


def sources() -> list[Path]:
    """Code, rules, settings and templates; not the lists of this module."""
    files = tracked("*.py", "*.smk", "Snakefile", "*.yaml", "*.yml", "*.toml", "*.j2", "*.sh", "Makefile", "config/*.tsv")
    return [path for path in files if path != Path(__file__).resolve()]


def pages() -> list[Path]:
    return tracked("*.md")


@cache
def anchors(page: Path) -> frozenset[str]:
    """Ids of a Markdown page: explicit ones, and GitHub's slugs of its headings."""
    found, fenced = set(), False
    seen: dict[str, int] = {}
    for line in page.read_text().splitlines():
        fenced ^= line.lstrip().startswith("```")
        found.update(re.findall(r'<a id="([^"]+)"', line))
        heading = None if fenced else re.match(r"#{1,6} +(.*?)\s*#*$", line)
        if heading:
            text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading[1])
            slug = re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-")
            count = seen.get(slug, 0)
            seen[slug] = count + 1
            found.add(f"{slug}-{count}" if count else slug)
    return frozenset(found)


def pages_of(letter: str) -> list[Path]:
    """Pages with equations of a letter: one of the method, and pages of the laboratory that continue it."""
    page = ROOT / "docs/method" / f"{PAGE_OF_LETTER.get(letter, '')}.md"
    return [path for path in [page, *sorted((ROOT / "lab/docs").glob("*.md"))] if path.is_file()]


def missing_equations(text: str) -> list[str]:
    """Equations that a text cites and no page has."""
    out = []
    for citation in EQUATION.finditer(text):
        for letter, number in NUMBER.findall(citation[0]):
            if not any(f"eq-{letter.lower()}{number}" in anchors(page) for page in pages_of(letter)):
                out.append(f"Eq. {letter}.{number}")
    return out


def missing_pages(text: str) -> list[str]:
    """`docs/...md#heading` that a text cites and that do not exist."""
    out = []
    for citation in PAGE.findall(text):
        name, _, anchor = citation.partition("#")
        if not (ROOT / name).is_file() or (anchor and anchor not in anchors(ROOT / name)):
            out.append(citation)
    return out


def missing_links(page: Path) -> list[str]:
    """Relative links of a page that lead nowhere."""
    out = []
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    for groups in LINK.findall(text):
        target = groups[0] or groups[1]
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path)):
            out.append(target)
    return out


@pytest.mark.parametrize("find", [missing_equations, missing_pages], ids=["equations", "pages"])
def test_citations_of_code_resolve(find):
    found = {str(path.relative_to(ROOT)): missing for path in sources() if (missing := find(path.read_text(errors="replace")))}
    assert not found


def test_citations_and_links_of_pages_resolve():
    found = {}
    for page in pages():
        text = page.read_text()
        missing = [*missing_equations(text), *missing_links(page)]
        if missing:
            found[str(page.relative_to(ROOT))] = missing
    assert not found


def test_nothing_cites_what_does_not_ship():
    found = []
    for path in [*sources(), *(page for page in pages() if page.name != "CHANGELOG.md")]:
        for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
            if UNSHIPPED.search(line):
                found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}")
    assert not found


def test_every_equation_is_numbered_once_and_in_order():
    """The numbers of a letter run without a gap over its page and the pages of the laboratory, in order on each."""
    for letter in [*PAGE_OF_LETTER, "T"]:
        numbers = []
        for page in pages_of(letter):
            text = page.read_text()
            ids = [int(number) for number in re.findall(rf'<a id="eq-{letter.lower()}(\d+)"', text)]
            tags = [int(number) for number in re.findall(rf"\\tag\{{{letter}\.(\d+)\}}", text)]
            assert ids == tags == sorted(ids), (letter, page)
            numbers += ids
        assert sorted(numbers) == list(range(1, len(numbers) + 1)), letter
        assert numbers, letter


def test_the_finders_find():
    """A test of citations that finds nothing in a text with mistakes would prove nothing."""
    assert missing_equations("see Eq. F.9999 and Eqs. Q.1") == ["Eq. F.9999", "Eq. Q.1"]
    assert missing_pages("(docs/nowhere.md, docs/method/fusion.md#no-such-heading)") == [
        "docs/nowhere.md",
        "docs/method/fusion.md#no-such-heading",
    ]
    assert UNSHIPPED.search("as in MANUAL 2.3") and UNSHIPPED.search(f"guards (H{45})") and not UNSHIPPED.search("an H200 GPU")
