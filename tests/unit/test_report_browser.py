"""report.html in a browser: what a person does with it by mouse, finger and keyboard, and without JavaScript."""

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image

from tests.browser import DESKTOP, PHONE, axe
from workflow.report import pictures as pic
from workflow.report.downloads import Command, downloads
from workflow.report.page import Number, Page, Pair, Picture, Strip, Table, ViewRows, render_page
from workflow.report.verdict import Evidence, judge

SIZE = 40
RAMP = np.repeat(np.repeat(np.linspace(0, 1, SIZE)[None, :, None], SIZE, 0), 3, -1)
"""Grows from left to right: every column has its own value."""


def picture(title, image, kind="sensor", high=1.0, unit="sensor value", lossless=True):
    return Picture(title, pic.data_uri(image, lossless), "a note", kind, 0.0, high, unit)


def pair(name, score):
    photograph = picture("photograph", pic.encoded(RAMP))
    return Pair(name, photograph, picture("re-rendering", pic.encoded(1 - RAMP)), SIZE, SIZE, score, False)


def view(name):
    maps = [
        picture("re-rendering", pic.encoded(1 - RAMP)),
        picture("albedo", pic.linear(0.5 * RAMP), "srgb", 1.0, "albedo, linear"),
        picture("roughness", pic.grey(RAMP[..., 0]), "grey", 1.0, "roughness"),
        picture("re-rendering error", pic.scalar(0.25 * RAMP[..., 0], 0, 0.25, "error"), "error", 0.25, "sensor value"),
    ]
    return ViewRows(name, "40 x 40", [Strip("result", maps), Strip("truth", [picture("photograph", pic.encoded(RAMP)), None])])


def content():
    objects = [
        {
            "object_id": str(i), "name": name, "base_colour_hex": colour, "luminance": str(level), "linear": f"{level}, 0, 0",
            "level": "(× 0.9 to 1.1)", "roughness": str(1 - level), "roughness_text": f"{1 - level:.2f}",
            "roughness_interval": "", "metallic": "0", "metallic_text": "0.00", "metallic_interval": "", "pixels": str(pixels),
            "photographs": "2", "model": "full",
        }
        for i, (name, colour, level, pixels) in enumerate(
            [("wall", "#ff0000", 0.5, 900), ("<b>sofa</b>", "#00ff00", 0.2, 1000), ("lamp shade", "#0000ff", 0.8, 80)]
        )
    ]  # fmt: skip
    emitter = {
        "id": 0, "name": "light", "object": "lamp", "kind": "area", "faces": 2, "area": 0.5, "radiance": "4, 4, 3",
        "error": "1, 1, 1", "swatch": "#ffffcc", "share": "99 %", "probability": "93 %", "power": "5", "brightness": "11",
        "observations": 70, "kept": True, "reason": "",
    }  # fmt: skip
    line = np.linspace(0, 1, 5)
    return Page(
        scene="room", credit="by nobody", hero=pair("v1", 25.0), hero_note="View v1", headline="Words.",
        verdict=judge(Evidence(escape=0.7, photographs=9, lamps=1, level="found", level_error=0.1, used=21.0)),
        numbers=[Number("photographs", "25.0 dB", "rgb-raw-psnr")],
        explanations=[("rgb-raw-psnr", "PSNR", "Peak signal-to-noise ratio."), ("albedo-raw-l2", "L2", "Error.")],
        facts=[("quality", "draft")], notes=["a note"], warnings=["a warning"],
        plan=[dict(component="sun", included=False, status="settled", measure="m", value=1.0, threshold=2.0, reason="r")],
        tables=[Table("Scores", [("albedo", 1)], ["L2 ↓"], [["base", "0.1"], ["result", "0.01"]], explained=["albedo-raw-l2"])],
        pairs=[pair("v2", 20.0), pair("v1", 25.0)], pairs_note="Drag.", views=[view("v2"), view("v1")],
        objects=objects, objects_note="Intervals.", overview=pair("v1", 25.0).photograph.source,
        emitters=[emitter, {**emitter, "id": 1, "kept": False, "reason": "dark"}], emitter_note="", response_note="A curve.",
        response_svg=pic.curves_svg([(line, line**0.5, "red", False)], "Response"),
        timings=[{"rule": "base", "seconds": 1.0, "cpu_seconds": 2.0, "max_rss_mb": 3.0, "threads": 2, "expected": {}}],
        versions=[("numpy", "2")], downloads=downloads(["scene.glb", "maps/v1.exr"]), commands=[Command("again", "snakemake x")],
    )  # fmt: skip


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(render_page(content()))
    return path


@pytest.mark.parametrize(("viewport", "touch", "scheme"), [(DESKTOP, False, "light"), (PHONE, True, "dark")])
def test_accessible_quiet_and_within_the_screen(report, opened, scheme, viewport, touch):
    page = opened(report, viewport, touch, color_scheme=scheme)
    page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
    assert axe(page) == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.locator("main").count() == 1 and page.locator("h1").count() == 1
    levels = page.evaluate("[...document.querySelectorAll('main h1, main h2, main h3, main h4')].map(h => Number(h.tagName[1]))")
    assert levels[0] == 1 and all(after <= before + 1 for before, after in zip(levels, levels[1:], strict=False))
    assert page.seen.complaints == [] and page.seen.outside == []


def test_opens_with_a_picture_and_four_lights(report, opened):
    page = opened(report)
    box = page.locator(".hero .pair").bounding_box()
    assert box["y"] < 150 and box["width"] > 400
    lights = page.locator(".lights > li")
    assert lights.locator(".name").all_inner_texts() == ["geometry: poor", "light: good", "materials: doubtful", "scale: good"]
    assert "To do: Close the mesh" in lights.first.inner_text()
    assert lights.nth(3).bounding_box()["y"] < 800  # all four on the first screen


def test_slider_by_keyboard_mouse_and_finger(report, opened):
    page = opened(report)
    pair_, slider = page.locator(".hero .pair"), page.locator(".hero input")
    box = pair_.bounding_box()

    def shown(share):
        """Colours of the top row at a share of the width, as they are on the screen."""
        image = np.asarray(Image.open(io.BytesIO(page.screenshot(clip=box))).convert("L")).astype(float)
        return image[20, int(share * image.shape[1])]

    assert shown(0.1) < 60 < 195 > shown(0.9)  # dark on both outer sides: the ramp and its mirror
    slider.focus()
    page.keyboard.press("End")
    assert shown(0.9) > 195  # photograph alone
    assert slider.get_attribute("aria-valuetext") == "100 % photograph"
    page.mouse.click(box["x"] + 0.02 * box["width"], box["y"] + 0.5 * box["height"])
    assert shown(0.1) > 195  # re-rendering alone
    phone = opened(report, PHONE, True)
    small = phone.locator(".hero .pair").bounding_box()
    phone.touchscreen.tap(small["x"] + 0.75 * small["width"], small["y"] + 100)
    assert 70 < int(phone.locator(".hero input").input_value()) < 80


def test_table_sorts_and_finds(report, opened):
    page = opened(report)
    names = page.locator("#objects tbody th")
    page.locator("#objects thead button", has_text="pixels seen").click()
    assert names.all_inner_texts() == ["lamp shade", "wall", "<b>sofa</b>"]  # by number, not by letters
    page.locator("#objects thead button", has_text="pixels seen").press("Enter")
    assert names.all_inner_texts() == ["<b>sofa</b>", "wall", "lamp shade"]
    assert page.locator("#objects thead th[aria-sort]").get_attribute("aria-sort") == "descending"
    page.locator("#find").fill("LAMP")
    assert page.locator("#objects tbody tr:visible").count() == 1 and page.locator("#found").inner_text() == "1 of 3"


def test_numbers_are_explained_on_focus_and_hover(report, opened):
    page = opened(report)
    number, tip = page.locator(".numbers a.tip"), page.locator("#tip")
    assert not tip.is_visible()
    number.focus()
    assert tip.is_visible() and tip.inner_text() == "Peak signal-to-noise ratio."
    page.keyboard.press("Escape")
    assert not tip.is_visible()
    number.hover()
    assert tip.is_visible()


def test_theme_is_chosen_and_kept(report, opened):
    page = opened(report, color_scheme="light")
    ground = "getComputedStyle(document.body).backgroundColor"
    before = page.evaluate(ground)
    page.locator("#theme").click()
    assert page.evaluate(ground) != before and page.locator("#theme").inner_text() == "Light"
    page.locator("#theme").click()
    assert page.evaluate(ground) == before


def test_pictures_enlarge_with_values_and_one_zoom(report, opened):
    page = opened(report)
    page.locator(".map button").nth(1).press("Enter")  # albedo of view v2
    viewer = page.locator("#viewer")
    assert viewer.is_visible() and viewer.locator("h2").inner_text() == "View v2"
    assert viewer.locator("select").evaluate_all("all => all.map(s => s.selectedOptions[0].text)") == [
        "result: albedo", "photograph: photograph", "result: re-rendering",
    ]  # fmt: skip
    stage = viewer.locator(".stage").first
    image = viewer.locator(".stage img").first.bounding_box()
    column = 30
    page.mouse.move(image["x"] + (column + 0.5) / SIZE * image["width"], image["y"] + 0.5 * image["height"])
    values = viewer.locator("output").all_inner_texts()
    albedo, photo, rendered = (float(text.split(",")[0]) for text in values)
    expected = RAMP[0, column, 0]
    assert albedo == pytest.approx(0.5 * expected, abs=0.005) and "albedo, linear" in values[0]
    assert photo == pytest.approx(expected, abs=0.003) and rendered == pytest.approx(1 - expected, abs=0.003)
    viewer.locator("select").nth(1).select_option(label="result: re-rendering error")
    page.mouse.move(image["x"] + (column + 0.6) / SIZE * image["width"], image["y"] + 0.5 * image["height"])
    assert float(viewer.locator("output").nth(1).inner_text().split()[0]) == pytest.approx(0.25 * expected, abs=0.002)
    stage.focus()
    page.keyboard.press("ArrowRight")
    assert float(viewer.locator("output").first.inner_text().split(",")[0]) > albedo
    page.mouse.wheel(0, -500)
    page.wait_for_timeout(50)
    widths = {round(box["width"]) for box in (i.bounding_box() for i in viewer.locator(".stage img").all())}
    assert len(widths) == 1 and widths.pop() > 1.5 * image["width"]  # all pictures, by the same factor
    page.keyboard.press("Escape")
    assert not viewer.is_visible()
    assert page.seen.complaints == []


def test_readable_without_javascript(report, opened):
    page = opened(report, java_script_enabled=False)
    assert not page.locator("#theme").is_visible() and not page.locator(".hero input").is_visible()
    left, right = (page.locator(f".hero img[data-name*='{name}']").bounding_box() for name in ("photograph", "re-rendering"))
    assert left["x"] + left["width"] <= right["x"] and left["y"] == right["y"]  # side by side
    assert page.locator("#objects tbody tr").count() == 3 and page.locator("a[href='scene.glb']").is_visible()


def test_prints_light_and_without_controls(report, opened):
    page = opened(report, color_scheme="dark")
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert not page.locator("header").is_visible() and not page.locator(".copy").is_visible()


def test_text_of_users_is_escaped(tmp_path, opened):
    path = tmp_path / "report.html"
    nasty = "<img src=x onerror=alert(1)>"
    path.write_text(render_page(dataclasses.replace(content(), scene=nasty, credit=nasty, notes=[nasty])))
    page = opened(path)
    assert page.locator("h1").inner_text() == nasty and page.locator("img[src=x]").count() == 0
    assert page.seen.complaints == [] and page.seen.outside == []
