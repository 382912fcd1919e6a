"""Headless Chromium for the pages that people open, and axe-core for their accessibility.

A test module takes the fixtures by name: `from tests.browser import axe, browser, page_for  # noqa: F401`.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
AXE = REPOSITORY / ".node/node_modules/axe-core/axe.min.js"
"""Installed by `make validator`, beside the validator of glTF."""

QUIET = [
    "--no-sandbox",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""WebGL without a GPU."""


def missing(what: str) -> None:
    """Skip the test because `what` is not installed; where IIF_REQUIRE_BROWSER is set (continuous integration), fail instead."""
    if os.environ.get("IIF_REQUIRE_BROWSER"):
        pytest.fail(f"{what}, and IIF_REQUIRE_BROWSER is set", pytrace=False)
    pytest.skip(what)


def chromium() -> str:
    """Return the path of Chromium or Chrome; skips the test where there is none."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        missing("no Chromium on the path (Debian: apt-get install chromium)")
    return str(found)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium that Playwright drives."""
    from playwright.sync_api import sync_playwright

    path = chromium()
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=path, args=[*QUIET, *SOFTWARE_GL])
        yield running
        running.close()


@pytest.fixture
def page_for(browser) -> Iterator[Callable[..., Any]]:
    """`page_for(path, viewport=(1280, 800), touch=False, **context)`: a page that shows a file, as from a double click.

    The page has `errors` (messages of the console and exceptions) and `requests` (addresses asked for that are neither the file
    itself nor `data:` or `blob:`). `context` goes to Playwright's `new_context`, such as `color_scheme` or `java_script_enabled`.
    """
    contexts = []

    def open_page(path: Path | str, viewport: tuple[int, int] = (1280, 800), touch: bool = False, **context: Any) -> Any:
        size = {"width": viewport[0], "height": viewport[1]}
        own = browser.new_context(viewport=size, has_touch=touch, is_mobile=touch, **context)
        contexts.append(own)
        page = own.new_page()
        address = Path(path).resolve().as_uri()
        page.errors, page.requests = [], []
        page.on("console", lambda message: page.errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: page.errors.append(str(error)))

        def asked(request: Any) -> None:
            if not request.url.startswith(("data:", "blob:")) and request.url.split("#")[0].split("?")[0] != address:
                page.requests.append(request.url)

        page.on("request", asked)
        page.goto(address)
        return page

    yield open_page
    for own in contexts:
        own.close()


def axe(page: Any, **options: Any) -> list[dict[str, Any]]:
    """Return what axe-core finds: `id`, `impact`, `help` and `nodes` (their HTML) of every violation; skips without axe-core.

    The content policy of the page forbids foreign scripts, so axe is evaluated by the debugger.
    """
    if not AXE.is_file():
        missing("axe-core is not in .node (make validator)")
    page.evaluate(AXE.read_text() + "\n;undefined")
    found = page.evaluate("options => axe.run(document, options)", options)
    return [
        {"id": v["id"], "impact": v["impact"], "help": v["help"], "nodes": [node["html"][:200] for node in v["nodes"]]}
        for v in found["violations"]
    ]
