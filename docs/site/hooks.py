"""What `make docs` adds to mkdocs: equations as MathML, and links that leave docs/.

The pages are written for GitHub and for mkdocs. GitHub renders `$...$` itself and follows relative links into the whole
repository. Here equations are translated to MathML while the site is built, so that the site needs neither scripts nor a
network for them, and the few pages of the repository that lie outside docs/ become pages of the site. Everything that cannot
be translated or resolved is a warning, which `mkdocs build --strict` turns into an error.
"""

from __future__ import annotations

import html
import logging
import posixpath
import re
from pathlib import Path
from xml.etree import ElementTree

from latex2mathml.converter import convert
from mkdocs.structure.files import File

REPOSITORY = Path(__file__).resolve().parents[2]
LOG = logging.getLogger("mkdocs.hooks.site")
ElementTree.register_namespace("", "http://www.w3.org/1998/Math/MathML")

OUTSIDE = {
    "CONTRIBUTING.md": "development/contributing.md",
    "CHANGELOG.md": "development/changelog.md",
    "config/README.md": "reference/configuration.md",
    "envs/README.md": "development/environment.md",
    "envs/licences.md": "reference/licences.md",
    "README.md": "index.md",
}
"""Pages of the repository outside docs/ -> where they are on the site."""

# ------------------------------------------------------------------------------------------------------------ links

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\(([^)\s]+)\)")
_NO_LINKS = re.compile(r"(```.*?```|~~~.*?~~~|`+[^`\n]*`+|\$\$.*?\$\$|\$[^$\n]+\$)", re.S)


def on_files(files, config):
    """Add the pages that lie outside docs/."""
    for source, target in OUTSIDE.items():
        if target != "index.md":
            files.append(File.generated(config, target, content=(REPOSITORY / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown, page, config, files):
    """Rewrite links that are relative to the page's place in the repository and leave docs/."""
    there = {target: source for source, target in OUTSIDE.items() if target != "index.md"}
    source = there.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def link(match):
        picture, text, target = match.groups()
        if re.match(r"[a-z]+:|#|/", target):
            return match[0]
        path, _, anchor = target.partition("#")
        named = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        if not (REPOSITORY / named).exists():
            LOG.warning("%s: the link to %s leads nowhere", source, target)
            return match[0]
        place = OUTSIDE.get(named) or (named.removeprefix("docs/") if named.startswith("docs/") else None)
        if place is None or (REPOSITORY / named).is_dir():
            return text  # a file or folder that is no page: its name stays
        relative = posixpath.relpath(place, posixpath.dirname(page.file.src_uri) or ".")
        return f"{picture}[{text}]({relative}{f'#{anchor}' if anchor else ''})"

    parts = _NO_LINKS.split(markdown)
    return "".join(part if i % 2 else _LINK.sub(link, part) for i, part in enumerate(parts))


# -------------------------------------------------------------------------------------------------------- equations

_MATH = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.S)
_TAG = re.compile(r"\\tag\{([^{}]*)\}")
_NAMESPACE = "http://www.w3.org/1998/Math/MathML"
_FENCES = {  # TeX's sized and one-sided delimiters -> a character of the private use area, the sign, and its side
    r"\lVert": ("\ue000", "\u2016", "prefix"),
    r"\rVert": ("\ue001", "\u2016", "postfix"),
    r"\lvert": ("\ue002", "|", "prefix"),
    r"\rvert": ("\ue003", "|", "postfix"),
    r"\lbrace": ("\ue004", "{", "prefix"),
    r"\rbrace": ("\ue005", "}", "postfix"),
    r"\lfloor": ("\ue006", "\u230a", "prefix"),
    r"\rfloor": ("\ue007", "\u230b", "postfix"),
    r"\lceil": ("\ue008", "\u2308", "prefix"),
    r"\rceil": ("\ue009", "\u2309", "postfix"),
}
_OF_PRIVATE = {private: (sign, side) for private, sign, side in _FENCES.values()}
_FENCE = re.compile(rf"(?<!\\left)(?<!\\right)(?:{'|'.join(map(re.escape, _FENCES))})(?![A-Za-z])")
_SPELLINGS = (
    (re.compile(r"\\(begin|end)\{aligned\}"), r"\\\1{split}"),
    (re.compile(r"\\operatorname\*"), r"\\operatorname"),
    (re.compile(r"\\arg(?![A-Za-z])"), r"\\operatorname{arg}"),
    (re.compile(r"\\cr(?![A-Za-z])"), r"\\\\"),
)
"""What latex2mathml does not know -> what it knows."""
_UNREAD = {
    "an equation was not recognised": re.compile(r"\$\$|\\(?:tag|frac|sum)\b.{0,40}"),
    "a table was not recognised (a blank line before it?)": re.compile(r".{0,40}\|-{3}"),
    "a list was not recognised (a blank line before it?)": re.compile(r"<p>(?:(?!</p>).)*\n(?:[*-]|\d\.) .{0,40}", re.S),
}
"""Markdown that GitHub reads and Python-Markdown leaves as text."""
_LIMITS = frozenset(("min", "max", "median", "argmin", "argmax", "lim", "sup", "inf"))
_ACCENTS = frozenset("~^\u00af\u02c6\u02dc\u2192\u02d9\u2015")


def mathml(latex: str, block: bool) -> str:
    """An equation without `\\tag` as a MathML element that browsers render without scripts (MathML Core).

    Raises:
        ValueError: a command that latex2mathml leaves as it is.
    """
    for pattern, known in _SPELLINGS:
        latex = pattern.sub(known, latex)
    latex = _FENCE.sub(lambda match: _FENCES[match[0]][0], latex)
    root = ElementTree.fromstring(convert(latex.strip(), display="block" if block else "inline"))
    for node in root.iter():
        _mend(node, block)
    text = ElementTree.tostring(root, encoding="unicode")
    if unknown := sorted(set(re.findall(r"\\[A-Za-z]+", text))):
        raise ValueError(f"latex2mathml does not know {', '.join(unknown)}")
    return text


def _mend(node: ElementTree.Element, block: bool) -> None:
    """What MathML Core asks for beyond what latex2mathml writes."""
    name, text = node.tag.rpartition("}")[2], node.text or ""
    if text in _OF_PRIVATE:
        node.text, side = _OF_PRIVATE[text]
        node.tag = f"{{{_NAMESPACE}}}mo"
        node.attrib |= {"form": side, "stretchy": "true" if "minsize" in node.attrib else "false"}
    elif name in ("msub", "msubsup") and block and (node[0].text or "") in _LIMITS:
        node.tag = f"{{{_NAMESPACE}}}{'munder' if name == 'msub' else 'munderover'}"
    elif name == "mover" and (node[1].text or "") in _ACCENTS:
        node.attrib["accent"] = "true"
    elif name == "mrow" and len(node) > 1 and all(_is_letter(child) for child in node):
        word = "".join(child.text for child in node)  # \mathrm{clamp}: one name, not five variables
        style = {"style": "font-family: sans-serif"} if node[0].get("mathvariant") == "sans-serif" else {}
        node[:] = [ElementTree.Element(f"{{{_NAMESPACE}}}mi", style)]
        node[0].text = word
    elif name == "mo" and (text == "/" or (len(text) > 1 and text.isalpha())):  # min, log: no space of a binary operator
        node.attrib |= {"lspace": "0.12em", "rspace": "0.12em"}
    elif name == "mo" and "minsize" in node.attrib and text in "()[]{}":
        node.attrib |= {"form": "prefix" if text in "([{" else "postfix", "stretchy": "true", "symmetric": "true"}
    elif node.get("mathvariant") in ("monospace", "sans-serif"):
        node.set("style", f"font-family: {node.attrib.pop('mathvariant')}")


def _is_letter(node: ElementTree.Element) -> bool:
    return node.get("mathvariant") in ("normal", "sans-serif") and len(node.text or "") == 1 and not len(node)


def on_page_content(content, page, config, files):
    """Translate the equations that `pymdownx.arithmatex` has marked; a `\\tag` stands at the right margin."""

    def equation(match):
        block = match[1] == "div"
        latex = html.unescape(match[2]).strip()[2:-2]  # without \( \) or \[ \]
        tag = _TAG.search(latex)
        try:
            math = mathml(_TAG.sub("", latex), block)
        except Exception as error:
            LOG.warning("%s: equation not understood (%s): %s", page.file.src_uri, error, latex)
            return match[0]
        if not block:
            return math
        number = f'<span class="number">({html.escape(tag[1])})</span>' if tag else ""
        return f'<div class="equation"><div class="formula">{math}</div>{number}</div>'

    found = _MATH.sub(equation, content)
    prose = re.sub(r"<(pre|code).*?</\1>", "", found, flags=re.S)
    for what, pattern in _UNREAD.items():
        if stray := pattern.search(prose):
            LOG.warning("%s: %s: ...%s...", page.file.src_uri, what, stray[0][:80])
    return found
