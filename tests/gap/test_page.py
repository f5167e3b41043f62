# Licensed under a 3-clause BSD style license - see LICENSE
"""The pages of a diagnosis and of the health in a browser, and for a screen reader."""

import base64
import html
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from io import BytesIO

import matplotlib.image
import pytest
from gap_data import chain, observed, with_effect

from astropolcal.gap import diagnose
from astropolcal.gap.report import to_dict, write_html
from astropolcal.pipeline.monitoring import write_health
from astropolcal.scripts._diagnose import _figures, _size_figures

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
QUIET = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--enable-logging=stderr",
    "--v=0",
]
SECTIONS = [
    "Causes",
    "What to observe next",
    "Figures",
    "Where the gap lies",
    "Accuracy before and after",
    "What was tried",
    "Model and data",
]
NEXT = {
    "exposure": "Take 8 frames",
    "words": "Take 8 frames: tells a from b at 9 standard deviations",
    "separates": ["a", "b"],
}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page of a small diagnosis with all sections."""
    data = observed(with_effect("beam_gain", imbalance=0.01), name="a <run>")
    diagnosis = diagnose(
        chain(), data, effects=["beam_gain", "hwp_diattenuation", "hwp_tilt"], cells=False
    )
    content = to_dict(diagnosis)
    # whether there is something to tell apart depends on the noise
    content["next_observations"] = [NEXT | {"gain": 9.0}]
    diagnosis.content = content
    path = tmp_path_factory.mktemp("page") / "gap.html"
    figures, sizes = _figures(diagnosis), _size_figures(diagnosis, content)
    assert len(figures) == 4
    write_html(diagnosis, path, figures=figures, size_figures=sizes)
    return path


@pytest.fixture(scope="module")
def text(page):
    return page.read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def browser():
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed")
    return found


def rendered(browser, path, folder, *more):
    """Return the document after loading, and what the browser had to say about it."""
    command = [browser, *QUIET, *more, f"--user-data-dir={folder}", "--dump-dom", path.as_uri()]
    result = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    return result.stdout, [line for line in result.stderr.splitlines() if "CONSOLE" in line]


class Outline(HTMLParser):
    """Headings, images and tables of a page."""

    def __init__(self, text):
        super().__init__()
        self.headings, self.images, self.tables, self.tags, self.ids = [], [], [], [], set()
        self._level = None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.append((tag, attrs))
        self.ids |= {attrs["id"]} if "id" in attrs else set()
        if tag in ("h1", "h2", "h3"):
            self._level = tag
            self.headings.append([tag, ""])
        if tag == "img":
            self.images.append(attrs)
        if tag == "table":
            self.tables.append([attrs, []])
        if tag == "th":
            self.tables[-1][1].append(attrs)

    def handle_endtag(self, tag):
        self._level = None if tag == self._level else self._level

    def handle_data(self, data):
        if self._level:
            self.headings[-1][1] += data


# ---- in a browser --------------------------------------------------------------------------


@pytest.mark.slow
def test_a_browser_shows_all_of_it_without_a_complaint(browser, page, tmp_path):
    dom, complaints = rendered(browser, page, tmp_path / "profile")
    assert complaints == []
    outline = Outline(dom)
    assert [words for level, words in outline.headings if level == "h2"] == SECTIONS
    assert len(outline.images) >= 4
    assert "a &lt;run&gt;" in dom


def test_a_page_that_asks_for_the_network_would_be_noticed(browser, page, tmp_path):
    asking = tmp_path / "asking.html"
    picture = '<img src="http://localhost:9/picture.png" alt="">'
    asking.write_text(page.read_text(encoding="utf-8").replace("</main>", f"{picture}</main>"))
    _, complaints = rendered(browser, asking, tmp_path / "profile")
    assert any("Content Security Policy" in line for line in complaints)


# a window cannot be as narrow as a telephone, a frame in it can
_FRAMES = """<body><script>
const seen = {};
async function look(width) {
  const frame = document.createElement("iframe");
  frame.style = `border: 0; width: ${width}px; height: 900px`;
  const loaded = new Promise(resolve => { frame.onload = resolve; });
  frame.src = PAGE;
  document.body.append(frame);
  await loaded;
  const page = frame.contentDocument, box = each => each.getBoundingClientRect();
  const beyond = [...page.querySelectorAll("body *")].filter(
    each => !each.parentElement.closest(".scroll") && box(each).right > width + 1);
  seen[width] = {
    room: page.documentElement.clientWidth, content: page.documentElement.scrollWidth,
    text: box(page.querySelector("main")).width, beyond: beyond.map(each => each.outerHTML),
    images: [...page.images].map(image => [box(image).width, box(image).height]),
    title: [...page.querySelectorAll("h1 > *")].map(each => box(each).height),
    tables: [...page.querySelectorAll(".scroll.wide")].map(
      each => [each.scrollWidth > each.clientWidth,
               frame.contentWindow.getComputedStyle(each, "::before").content]),
  };
}
(async () => {
  for (const width of [400, 800, 1400]) await look(width);
  document.title = JSON.stringify(seen);
  document.body.innerHTML = "";
})();
</script></body>"""


def at_three_widths(browser, page, folder):
    """Return what a page measures on a telephone, a tablet and a desktop: it fits all of them."""
    path = page.with_name("frames.html")
    path.write_text(_FRAMES.replace("PAGE", json.dumps(page.name)))
    more = ["--allow-file-access-from-files", "--virtual-time-budget=20000"]
    dom, _ = rendered(browser, path, folder, *more)
    seen = json.loads(html.unescape(re.search(r"<title>(.*)</title>", dom)[1]))
    for width, found in seen.items():
        assert found["beyond"] == [], width
        assert found["content"] <= found["room"] <= int(width), width
    narrow, _, wide = seen.values()
    # figures fill the telephone
    assert {width for width, _ in narrow["images"]} == {narrow["text"]}
    assert all("sideways" in hint for _, hint in narrow["tables"])
    assert all(hint == "none" for _, hint in wide["tables"])
    return narrow, seen["800"], wide


@pytest.mark.slow
def test_page_of_the_health_fits_a_telephone_a_tablet_and_a_desktop(browser, page, tmp_path):
    path = tmp_path / "health.html"
    course = {key: 0.2 for key in ("constant", "steps", "drift", "walk", "scatter")}
    group = {
        "instrument": "charis",
        "mode": "broadband",
        "alarms": ["wollaston.efficiency has changed by 5 standard deviations"],
        "next": ["The next calibration is due by 2027-01-01."],
        "events": [{"words": f"{'a long reason ' * 20}on 2026-01-01"}],
        "left_out": ["of_another_mode.asdf"],
        "courses": [
            course | {"what": "calibration_polarizer.theta", "course": "steps", "or": ["hwp.theta"]}
        ],
        "calibrations": [
            {"date": "2026-01-01", "name": f"{'long_' * 20}name.asdf", "converged": True}
            | {"s_cv_percent": 0.123, "s_res_percent": None}
        ],
    }
    image = Outline(page.read_text(encoding="utf-8")).images[0]["src"]
    content = {"now": "2027-01-01T00:00:00", "groups": [group], "unreadable": {"x" * 200: "?"}}
    write_health(content, path, figures=[{"Accuracy": image}])
    at_three_widths(browser, path, tmp_path / "profile")


@pytest.mark.slow
def test_page_fits_a_telephone_a_tablet_and_a_desktop(browser, page, tmp_path):
    narrow, middle, wide = at_three_widths(browser, page, tmp_path / "profile")
    # the panels are below one another
    shapes = [[high / width for width, high in found["images"]] for found in (narrow, wide)]
    assert sum(one > 2 * other for one, other in zip(*shapes, strict=True)) >= 2
    assert max(width for width, _ in wide["images"]) > 800
    assert max(width for width, _ in middle["images"]) <= middle["text"]
    # one line each for what it is about and what came out
    assert max(narrow["title"]) < 40
    # what is wider than the telephone says that it can be moved
    assert any(is_wide for is_wide, _ in narrow["tables"])


# ---- without one ---------------------------------------------------------------------------


@pytest.mark.slow
def test_nothing_is_loaded_and_nothing_runs(text):
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text).group(1)
    rules = {rule.strip() for rule in policy.split(";")}
    assert rules == {"default-src 'none'", "style-src 'unsafe-inline'", "img-src data:"}
    assert not re.search(r"<script|<link|<iframe|\son\w+=|@import|url\(|https?://", text)


@pytest.mark.slow
def test_images_can_be_decoded_and_have_their_size(text):
    outline = Outline(text)
    for image in outline.images:
        kind, _, data = image["src"].partition(",")
        assert kind == "data:image/png;base64"
        pixels = matplotlib.image.imread(BytesIO(base64.b64decode(data)))
        height, width = pixels.shape[:2]
        assert min(width, height) > 200
        assert pixels[..., :3].std() > 0.05
        stated = int(image["width"]) / int(image["height"])
        assert stated == pytest.approx(width / height, rel=0.02)


@pytest.mark.slow
def test_a_screen_reader_finds_its_way(text):
    outline = Outline(text)
    assert ("html", {"lang": "en"}) in outline.tags
    assert [level for level, _ in outline.headings].count("h1") == 1
    assert all(len(image["alt"]) > 20 for image in outline.images)
    for attrs, heads in outline.tables:
        assert attrs.get("aria-labelledby") in outline.ids or attrs.get("aria-label")
        assert heads
        assert all(head.get("scope") in ("row", "col") for head in heads)
    named = [attrs["aria-labelledby"] for _, attrs in outline.tags if "aria-labelledby" in attrs]
    assert set(named) <= outline.ids


def luminance(color):
    digits = color * 2 if len(color) == 3 else color
    parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one, two):
    high, low = sorted((luminance(one), luminance(two)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.slow
def test_text_has_contrast_in_light_and_in_dark(text):
    """WCAG 2 asks for 4.5 for text; 7 is its stricter level."""
    schemes = re.findall(r":root \{([^}]*--page[^}]*)\}", text)[:2]
    pages = []
    for scheme in schemes:
        colors = dict(re.findall(r"--([\w-]+): #(\w+)", scheme))
        pages.append(luminance(colors["page"]))
        for back in ("page", "good-back", "bad-back"):
            assert contrast(colors["ink"], colors[back]) > 7
            assert contrast(colors["soft"], colors[back]) > 7
        # what marks the summary is no text
        assert contrast(colors["good"], colors["page"]) > 3
        assert contrast(colors["bad"], colors["page"]) > 3
    assert pages[0] > 0.9
    assert pages[1] < 0.05
