"""The report page: whole, well-formed, and without anything from elsewhere."""

from html.parser import HTMLParser

import numpy as np
import pytest
from commands import open_in_browser
from PIL import Image

from dynmap_rl.reporting.html import write_html
from dynmap_rl.runs.folder import append_metrics
from dynmap_rl.utils.files import write_json

VOID = {"meta", "img", "br", "hr", "link"}


class Page(HTMLParser):
    """Elements that were opened and closed in order, their attributes, their text."""

    def __init__(self, text):
        super().__init__()
        self.open, self.attributes, self.text = [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.attributes += [(tag, *pair) for pair in attributes]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.attributes += [(tag, *pair) for pair in attributes]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture
def folder(tmp_path):
    write_json(tmp_path / "config.json", {"task": "<script>alert(1)</script>", "world_model": {"updates": 7}})
    for step in (1, 2, 3):
        append_metrics(tmp_path, step, loss_rgb=1 / step, error_position=0.1)
        append_metrics(tmp_path / "seed_0", step, loss=1 / step, seconds=None)
    Image.new("RGB", (8, 8)).save(tmp_path / "rollouts.gif")
    return tmp_path


def test_the_page_is_whole_and_needs_nothing_beside_it(folder):
    command = "python recipes/decoupled.py --updates 7"
    text = write_html(folder, "RGB+[P] & more", "SR 50 %", command).read_text()
    page = Page(text)
    assert page.open == []
    for said in ("RGB+[P] & more", "SR 50 %", "world_model.updates", command):
        assert said in page.text
    assert not any(tag in ("script", "link", "iframe") for tag, *_ in page.attributes)
    assert "<script>" not in text
    for tag, name, value in page.attributes:
        if name in ("src", "href", "xlink:href"):
            assert value.startswith(("data:", "#")), (tag, value)
    titles = [value for tag, name, value in page.attributes if (tag, name) == ("img", "alt")]
    assert titles == ["Rollouts in closed loop, failures first"]


def test_the_same_run_gives_the_same_page(folder):
    first = write_html(folder, "title", "row").read_bytes()
    assert write_html(folder, "title", "row").read_bytes() == first


def test_a_run_without_results_has_a_page_too(tmp_path):
    write_json(tmp_path / "config.json", {"seed": 0})
    assert "seed" in Page(write_html(tmp_path, "title", "row").read_text()).text


@pytest.mark.slow
def test_a_browser_shows_the_whole_page_and_asks_for_nothing_else(folder, tmp_path):
    rng = np.random.default_rng(0)
    frames = [Image.fromarray(rng.integers(0, 255, (64, 96, 3), dtype=np.uint8)) for _ in range(3)]
    frames[0].save(folder / "rollouts.gif", save_all=True, append_images=frames[1:])
    (folder / "figures").mkdir()
    Image.new("RGB", (320, 40), "green").save(folder / "figures/dynamics.png")
    page = write_html(folder, "RGB+[P] & more", "SR 50 %", "python recipes/decoupled.py")
    seen = open_in_browser(page, tmp_path / "page.png")
    assert seen["loaded"] and seen["requests"] == [page.as_uri()] and seen["console"] == []
    assert seen["images"] == [96, 320], "every picture is drawn, at its own size"
    assert len(seen["drawings"]) == 1 and seen["drawings"][0] > 500, "the curves"
    for said in (
        "RGB+[P] & more",
        "SR 50 %",
        "Rollouts in closed loop",
        "<script>alert(1)</script>",
        "updates",
    ):
        assert said in seen["text"]
    shown = np.asarray(Image.open(tmp_path / "page.png").convert("RGB"))
    green = (shown == (0, 128, 0)).all(-1)
    assert green.sum() > 5000, "what the picture holds is on the screen"
