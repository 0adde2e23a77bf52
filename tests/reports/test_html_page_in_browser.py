"""The page as Chromium lays it out: on a desktop and a phone, in light and dark."""

import json
import re
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path
from typing import Any

import pytest

from astra_data.reports.files import published_figures, read_published
from astra_data.reports.html_page import render_html

PUBLISHED = Path(__file__).parents[2] / "recipes/results"
CHROMIUM = shutil.which("chromium")

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="chromium is not installed: apt-get install chromium"
)

MEASURE = """
addEventListener("load", () => {
  const inner = document.querySelector("iframe").contentWindow, page = inner.document;
  page.querySelectorAll("details").forEach((folded) => { folded.open = true; });
  const color = (name) => inner.getComputedStyle(page.querySelector(name)).backgroundColor;
  const boxed = (element) => element.closest(".scroll, .plate, nav ul, pre");
  const outside = [...page.querySelectorAll("body *")].filter(
    (element) => !boxed(element) && element.getBoundingClientRect().right > inner.innerWidth + 0.5);
  const cut = [...page.querySelectorAll("h1, h2, h3, p, dt, dd, li, summary, th, td, figcaption")].filter(
    (element) => element.scrollWidth > element.clientWidth + 1);
  const images = [...page.images];
  document.getElementById("probe").textContent = JSON.stringify({
    inner: inner.innerWidth,
    scroll: page.documentElement.scrollWidth,
    outside: outside.map((element) => element.outerHTML.slice(0, 80)),
    cut: cut.map((element) => element.outerHTML.slice(0, 80)),
    images: images.map((image) => [image.complete, image.naturalWidth, image.getBoundingClientRect().width]),
    tables: [...page.querySelectorAll(".scroll")].map((box) => [box.scrollWidth, box.clientWidth]),
    page: color("body"), plate: page.querySelector(".plate") ? color(".plate") : null,
  });
});
"""
"""A window of Chromium is 500 pixels wide or more, so the page is measured in a frame."""


def measured(text: str, folder: Path, width: int, *, dark: bool = False) -> Any:  # noqa: ANN401 - JSON
    """Return what Chromium measures of a page in a frame of that width."""
    frame = f'<iframe srcdoc="{escape(text)}" style="border:0" width="{width}" height="900"></iframe>'
    wrapper = folder / "wrapper.html"
    wrapper.write_text(
        f'<!doctype html><meta charset="utf-8"><pre id="probe"></pre>{frame}<script>{MEASURE}</script>'
    )
    assert CHROMIUM is not None
    done = subprocess.run(
        [
            *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000"),
            *(f"--user-data-dir={folder / 'profile'}", "--window-size=1400,1000"),
            f"--blink-settings=preferredColorScheme={0 if dark else 1}",
            *("--dump-dom", wrapper.as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    found = re.search(r'<pre id="probe">(.*?)</pre>', done.stdout, flags=re.DOTALL)
    assert found and found[1], done.stderr[-500:]
    return json.loads(unescape(found[1]))


def html_of(name: str) -> str:
    return render_html(read_published(PUBLISHED / f"{name}.json"), published_figures(PUBLISHED, name))


@needs_chromium
@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("name", ["antmaze_long_fresh", "humanoid_walker2d", "cart_sizes"])
def test_nothing_is_wider_than_the_page_and_all_images_are_there(
    name: str, width: int, tmp_path: Path
) -> None:
    found = measured(html_of(name), tmp_path, width)
    # A scroll bar takes some pixels of a desktop's.
    assert width - 20 <= found["inner"] <= width
    assert found["scroll"] <= found["inner"]
    assert found["outside"] == found["cut"] == []
    assert len(found["images"]) == len(published_figures(PUBLISHED, name))
    assert all(complete and natural > 0 and shown > 250 for complete, natural, shown in found["images"])
    if width == 390:
        assert any(scroll > client for scroll, client in found["tables"])


@needs_chromium
def test_a_page_without_its_boxes_would_be_noticed(tmp_path: Path) -> None:
    bare = html_of("cart_study").replace(".scroll { overflow-x: auto;", ".scroll {")
    found = measured(bare, tmp_path, 390)
    assert found["scroll"] > found["inner"]


@needs_chromium
def test_dark_pages_keep_figures_on_white(tmp_path: Path) -> None:
    text = html_of("cart_study")
    light, dark = (measured(text, tmp_path, 390, dark=dark) for dark in (False, True))
    assert light["plate"] == dark["plate"] == "rgb(255, 255, 255)"
    assert light["page"] == "rgb(251, 251, 250)" and dark["page"] == "rgb(20, 23, 26)"


@needs_chromium
def test_long_names_break(tmp_path: Path) -> None:
    results = read_published(PUBLISHED / "cart_study.json")
    long = results.model_copy(
        update={"recipe": "a_very_long_name_" * 8, "command": "astra-data " + "x" * 300}
    )
    found = measured(render_html(long, {}), tmp_path, 390)
    assert found["scroll"] <= found["inner"] and found["outside"] == []
