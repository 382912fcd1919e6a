"""A headless Chromium for tests of pages, and what it saw: messages, errors, requests.

On continuous integration a missing browser is a failure (`IIF_REQUIRE_BROWSER=1`, set by `.ci/run`); elsewhere the tests skip.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
QUIET = (
    "--no-sandbox",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
"""Nothing but what a test asks for."""
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
AXE = ROOT / ".node/node_modules/axe-core/axe.min.js"
DESKTOP, PHONE = (1280, 800), (390, 844)


def missing(what: str) -> None:
    """Skip the test, or fail where a browser is required."""
    if os.environ.get("IIF_REQUIRE_BROWSER") == "1":
        pytest.fail(f"{what}, and IIF_REQUIRE_BROWSER=1 asks for it", pytrace=False)
    pytest.skip(what)


def executable() -> str | None:
    """Return the path of Chromium: $IIF_BROWSER, else the first of `NAMES` on the path."""
    return os.environ.get("IIF_BROWSER") or next((found for name in NAMES if (found := shutil.which(name))), None)


@dataclass
class Seen:
    """What a page said and asked for.

    Attributes:
        page: of Playwright.
        messages: (type, text) of its console.
        errors: exceptions that nothing caught.
        requests: addresses, the page's own first.
    """

    page: Any
    messages: list[tuple[str, str]] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    @property
    def complaints(self) -> list[str]:
        """Errors, and messages of type error on the console, by which the browser reports violations of the policy."""
        return self.errors + [text for kind, text in self.messages if kind == "error"]

    @property
    def outside(self) -> list[str]:
        """Requests for anything but the page itself and what it made from its own data."""
        return [address for address in self.requests[1:] if not address.startswith(("blob:", "data:"))]


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Headless Chromium that draws WebGL by software."""
    found = executable()
    if found is None:
        missing(f"no Chromium: none of {', '.join(NAMES)} is installed; name one in IIF_BROWSER")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=found, args=[*QUIET, *SOFTWARE_GL])
        yield chromium
        chromium.close()


@pytest.fixture(scope="session")
def page_for(browser):
    """`with page_for(path, viewport=DESKTOP, touch=False, script="", **context) as seen`: open a file, and watch what it does.

    `script` runs before those of the page; `context` goes to Playwright's `new_context`, such as color_scheme="dark".
    """

    @contextmanager
    def opened(path: Path, viewport: tuple[int, int] = DESKTOP, touch: bool = False, script: str = "", **options: Any):
        size = {"width": viewport[0], "height": viewport[1]}
        context = browser.new_context(viewport=size, has_touch=touch, is_mobile=touch, **options)
        try:
            page = context.new_page()
            seen = Seen(page)
            page.on("console", lambda message: seen.messages.append((message.type, message.text)))
            page.on("pageerror", lambda error: seen.errors.append(str(error)))
            page.on("request", lambda request: seen.requests.append(request.url))
            if script:
                page.add_init_script(script)
            page.goto(Path(path).resolve().as_uri())
            yield seen
        finally:
            context.close()

    return opened


def axe(page: Any) -> list[dict[str, Any]]:
    """Run axe-core on a page and return its serious and critical findings: id, impact, help and the HTML of each node.

    The policy of the page does not hold for what the browser's own tools run, so axe-core goes in by them.
    """
    if not AXE.is_file():
        missing(f"{AXE.relative_to(ROOT)} is not there; `make node` installs it")
    page.evaluate(AXE.read_text(encoding="utf-8") + ";undefined")
    found = page.evaluate("async () => (await axe.run(document)).violations")
    return [
        {"id": one["id"], "impact": one["impact"], "help": one["help"], "nodes": [node["html"][:200] for node in one["nodes"]]}
        for one in found
        if one["impact"] in ("serious", "critical")
    ]
