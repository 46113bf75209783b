"""The pages in a browser: no console errors; sorting and filtering work; every control can be reached by keyboard."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from lab.report.index import write_index
from lab.report.run.page import write_report
from lab.results.view.page import View, read_content, view_of, write_page
from tests.lab.chromium import Browser
from tests.lab.report.test_report import make

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
# What a user does, and what the page then shows; appended to a copy of the page without its policy.
ACTIONS = """
<script>
const out = {}, rows = () => [...document.querySelectorAll("#runs tbody tr")].filter((row) => !row.hidden);
const names = () => rows().map((row) => row.cells[1].querySelector("a, th > :first-child")?.textContent ?? "");
const head = (word) => [...document.querySelectorAll("#runs thead button")].find((b) => b.textContent.startsWith(word));
out.first = rows().map((row) => row.dataset.verdict);
head("frames").click(); out.rising = rows().map((row) => row.dataset.verdict);
head("frames").click(); out.falling = rows().map((row) => row.dataset.verdict);
out.sorted = head("frames").closest("th").getAttribute("aria-sort");
document.querySelector("#filters button[data-verdict=fail]").click();
out.failed = rows().map((row) => row.dataset.verdict);
out.said = document.getElementById("shown").textContent;
document.getElementById("clear").click();
const search = document.getElementById("search");
search.value = "spots few"; search.dispatchEvent(new Event("input"));
out.found = rows().map((row) => row.dataset.verdict);
search.value = "nowhere"; search.dispatchEvent(new Event("input"));
out.none = !document.getElementById("none").hidden;
const kinds = "button, input, a[href], [tabindex], summary, [onclick], [role=button]";
const controls = [...document.querySelectorAll(kinds)];
out.controls = controls.length;
out.unreachable = controls.filter((e) => e.tabIndex < 0).map((e) => e.outerHTML.slice(0, 80));
out.nameless = controls.filter((e) => !(e.textContent.trim() || e.ariaLabel || e.title || e.labels?.length))
  .map((e) => e.outerHTML.slice(0, 80));
out.wide = document.documentElement.scrollWidth - innerWidth;
document.body.innerHTML = "";
document.title = JSON.stringify(out);
</script>
"""

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")]


def browse(page: Path, width: int = 1200) -> tuple[str, list[str]]:
    """The page's title after its scripts have run, and the messages of the console."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--virtual-time-budget=2000"]
    command = [str(CHROMIUM), *options, f"--window-size={width},900", "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return re.search(r"<title>(.*?)</title>", done.stdout, re.DOTALL)[1].replace("&amp;", "&"), console


@pytest.fixture(scope="module")
def index(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("index")
    rows = [
        {"name": "a", "status": "pass", "results": "a", "frames": 600, "run": "/d/1/a", "message": ""},
        {"name": "b", "status": "error", "frames": "", "run": "/d/1/b", "message": f"{'/long' * 30}: not there"},
        {"name": "c", "status": "fail", "results": "c", "frames": 20, "run": "/d/1/c", "message": "lost"},
        {"name": "d", "status": "check", "results": "d", "frames": 3000, "run": "/d/2/d", "message": "few spots"},
    ]
    for name in "acd":
        made = make(folder / "made" / name, 40)
        made.results.rename(folder / name)
    return write_index(rows, folder)


def test_the_index_sorts_filters_and_searches_and_has_no_console_errors(index):
    assert browse(index)[1] == []
    copy = index.with_name("copy.html")
    text = re.sub(r"<meta http-equiv.*?>", "", index.read_text("utf-8"), count=1)
    copy.write_text(text.replace("</body>", ACTIONS + "</body>"))
    title, console = browse(copy)
    seen = json.loads(title)
    assert console == []
    assert seen["first"] == ["error", "fail", "check", "pass"]
    assert (seen["rising"], seen["sorted"]) == (["fail", "pass", "check", "error"], "descending")
    assert seen["falling"] == ["check", "pass", "fail", "error"]  # what has no number stays last
    assert (seen["failed"], seen["said"]) == (["fail"], "1 of 4 runs shown")
    assert (seen["found"], seen["none"]) == (["check"], True)
    assert seen["controls"] > 10
    assert (seen["unreachable"], seen["nameless"]) == ([], [])


@pytest.mark.parametrize("width", [1000, 1400])
def test_the_index_fits_into_the_window(index, width):
    copy = index.with_name(f"{width}.html")
    text = re.sub(r"<meta http-equiv.*?>", "", index.read_text("utf-8"), count=1)
    script = "<script>document.title = document.documentElement.scrollWidth - innerWidth</script></body>"
    copy.write_text(text.replace("</body>", script))
    assert int(browse(copy, width)[0]) <= 0


def test_the_report_of_a_run_has_no_console_errors(tmp_path):
    assert browse(write_report(make(tmp_path, 300).results))[1] == []


SMALLEST_LETTER = """
Math.min(...[...document.querySelectorAll("svg text")].filter((t) => t.getBoundingClientRect().width).map((t) => {
  const svg = t.ownerSVGElement;
  return parseFloat(getComputedStyle(t).fontSize) * svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
}))
"""


@pytest.mark.parametrize("width", [420, 1300])
def test_the_pages_of_results_fit_into_a_window_and_the_letters_of_their_drawings_can_be_read(tmp_path, width):
    results = make(tmp_path, 300).results
    write_page(*_scene(results), tmp_path / "view.html")
    browser = Browser(tmp_path)
    try:
        for page in (write_report(results), tmp_path / "view.html"):
            browser.open(page.as_uri(), width)
            assert browser.get("document.documentElement.scrollWidth - document.documentElement.clientWidth") <= 0
            assert browser.get(SMALLEST_LETTER) > 6
    finally:
        browser.close()


INK = """
<script>
const c = document.getElementById("scene"), p = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
let rows = 0, edge = 0;
for (let y = 0; y < c.height; y++) for (let x = 0; x < c.width; x++) if (p[4 * (y * c.width + x) + 3]) {
  rows++;
  if (x < 2 || y < 2 || x > c.width - 3 || y > c.height - 3) edge++;
}
document.title = JSON.stringify({ rows, edge });
</script>
"""


@pytest.mark.parametrize("width", [500, 1300])
def test_the_scene_is_seen_whole_at_first(tmp_path, width):
    write_page(*_scene(make(tmp_path).results), tmp_path / "view.html")
    page = tmp_path / "view.html"
    text = re.sub(r"<meta http-equiv.*?>", "", page.read_text("utf-8"), count=1)
    page.write_text(text.replace("</body>", INK + "</body>"), "utf-8")
    ink = json.loads(browse(page, width)[0])
    assert ink["rows"] > 1000
    assert ink["edge"] == 0


def _scene(results: Path) -> tuple[View, int | None]:
    content = read_content(results, None)
    index = content.at_frame(None)
    return view_of(content, index), index
