"""The page of a batch in a browser: sorting, finding, addresses that show the same again, causes, and no JavaScript."""

import re

import pytest
from PIL import Image

from tests.browser import DESKTOP, PHONE, axe
from workflow.batch.columns import SCORES, VERDICTS
from workflow.batch.page import render
from workflow.batch.standing import STATES
from workflow.batch.summary import COLUMNS


def rows(count=12):
    """Rows of a summary: every third scene is not done, for two causes."""
    out = []
    for i in range(count):
        row = dict.fromkeys(COLUMNS) | {"line": i + 2, "scene": f"room-{i:04d}", "quality": "draft"}
        row |= {"source": "folder" if i % 2 else "builtin", "slowest": "base 5 s"}
        if i % 6 == 1:
            row |= {"status": "refused", "reason": f"config/batch.tsv, line {i + 2}: data/room-{i:04d}/a.png: {i} x 9 pixels"}
        elif i % 6 == 4:
            row |= {
                "status": "failed",
                "stage": "capture",
                "reason": "<b>no</b> mesh",
                "log": f"results/room-{i:04d}/logs/capture.log",
            }
        else:
            row |= {
                "status": "done",
                "report": f"scenes/room-{i:04d}/report.html",
                "views": 100 - i,
                "rgb_psnr": 9.5 + (7 * i) % 12,
            }
            row |= {"verdict": ("good", "poor", "doubtful")[i % 4 % 3], "doubt": "0 lamps found" if i % 4 % 3 else None}
            row |= {"seconds": 10.0 * i + 5, "cpu_seconds": 3.0 + i, "max_rss_mb": 400.0}
        out.append(row)
    return out


def write(folder, table):
    """The page with pictures in a folder; returns its path."""
    pictures = {row["scene"]: f"pictures/{row['scene']}.jpg" for row in table if row["status"] == "done"}
    (folder / "pictures").mkdir()
    for i, name in enumerate(pictures.values()):
        Image.new("RGB", (402, 100), (i % 256, 128, 90)).save(folder / name)
    path = folder / "report.html"
    path.write_text(render(table, "draft", SCORES, STATES, VERDICTS, pictures))
    return path


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    return write(tmp_path_factory.mktemp("batch"), rows())


def names(page):
    return page.locator("tbody.scenes tr:visible th").evaluate_all("all => all.map(th => th.dataset.sort.slice(-2))")


@pytest.mark.parametrize(("viewport", "touch", "scheme"), [(DESKTOP, False, "light"), (PHONE, True, "dark")])
def test_accessible_quiet_and_within_the_screen(batch, opened, viewport, touch, scheme):
    page = opened(batch, viewport, touch, color_scheme=scheme)
    page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
    assert axe(page) == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.seen.complaints == []
    assert all("/pictures/room-" in address for address in page.seen.outside) and page.seen.outside


def test_columns_sort_by_mouse_and_keyboard_and_what_is_unknown_comes_last(batch, opened):
    page = opened(batch)
    head = page.locator("thead th", has_text="re-rendering PSNR")
    head.get_by_role("button").click()
    assert head.get_attribute("aria-sort") == "ascending"
    assert names(page)[:3] == ["00", "02", "09"] and set(names(page)[-4:]) == {"01", "04", "07", "10"}
    head.get_by_role("button").press("Enter")
    assert head.get_attribute("aria-sort") == "descending" and page.locator("[aria-sort]").count() == 1
    assert names(page)[:2] == ["05", "03"] and set(names(page)[-4:]) == {"01", "04", "07", "10"}
    assert page.url.endswith("#sort=-rgb_psnr")
    assert page.locator("tbody.median th").inner_text() == "median of 8 done"  # stays where it is


def told(page, words):
    """Wait until the page tells how many scenes are found. Functions given as text would be evaluated, which the page forbids."""
    page.locator(".filters output", has_text=re.compile(f"^{words}$")).wait_for()


def test_rows_are_found_and_the_address_shows_the_same_again(batch, opened, page_for):
    page = opened(batch)
    page.get_by_label("Status").select_option("done")
    page.get_by_label("Source").select_option("folder")
    page.get_by_label("Name").fill("ROOM 0")
    page.locator("thead th", has_text="views").get_by_role("button").click()
    assert names(page) == ["11", "09", "05", "03"] and page.locator(".filters output").inner_text() == "4 of 12 scenes"
    page.get_by_label("Name").fill("ROOM 09")
    assert names(page) == ["09"]
    address = page.url
    page.goto("about:blank")
    page.goto(address)
    assert names(page) == ["09"] and page.get_by_label("Name").input_value() == "ROOM 09"
    page.get_by_role("button", name="Show all").click()
    assert names(page) == [f"{i:02d}" for i in range(12)] and page.locator("[aria-sort]").count() == 0
    assert page.evaluate("location.hash") == ""
    page.locator("a.state", has_text="refused").click()
    told(page, "2 of 12 scenes")
    assert names(page) == ["01", "07"]
    page.locator("a.state", has_text="poor").click()
    page.locator("tbody.scenes tr:visible th[data-sort$='05']").wait_for()  # as many scenes as before
    assert names(page) == ["05", "09"]
    page.evaluate("location.hash = '#sort=verdict'")
    told(page, "12 scenes")
    ranked = page.locator("tbody.scenes td.verdict").all_inner_texts()
    assert ranked == ["good"] * 4 + ["doubtful"] * 2 + ["poor"] * 2 + ["–"] * 4
    page.evaluate("location.hash = '#stage=capture&name=0010&sort=nonsense&status=none'")
    told(page, "1 of 12 scenes")
    assert names(page) == ["10"]


def test_failures_stand_together_by_cause(batch, opened):
    page = opened(batch)
    causes = page.locator("details.cause")
    assert [text.split(":")[0] for text in causes.locator("summary").all_inner_texts()] == [
        "2 scenes refused, such as room-0001",
        "2 scenes failed in capture, such as room-0004",
    ]
    causes.nth(1).locator("summary").press("Enter")
    assert causes.nth(1).locator("li a").first.get_attribute("href") == "../../results/room-0004/logs/capture.log"
    assert "<b>no</b> mesh" in causes.nth(1).locator("li").last.inner_text()


def test_everything_is_there_without_javascript(batch, opened):
    page = opened(batch, java_script_enabled=False)
    assert page.locator("tbody.scenes tr:visible").count() == 12 and page.locator("details.cause").count() == 2
    assert not page.locator(".filters").is_visible() and page.locator("thead button").count() == 0


@pytest.mark.long
def test_a_thousand_rows_are_light(tmp_path, opened):
    path = write(tmp_path, rows(1000))
    assert path.stat().st_size < 2e6
    page = opened(path)
    assert len(page.seen.outside) < 200  # pictures below the screen are not read
    page.locator("thead th", has_text="views").get_by_role("button").click()
    page.get_by_label("Name").fill("0999")
    assert names(page) == ["99"]
