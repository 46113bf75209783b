"""`beampose pick`: points get their names by clicks, keys and tables; the files are those of the contract."""

from __future__ import annotations

import csv
import io
import re

import cv2
import numpy as np
import pytest

from lab.calibrate.beams.recordings import read_spot_table
from lab.errors import InputError
from lab.files.project.point_files import read_observations
from lab.files.rig.rig_file import load_rig
from lab.runs.detect.detect import MOST_PICTURES, PickOptions, write_pick_page
from tests.lab.chromium import Browser, needs_chromium
from tests.paths import ROOT

PLACES = {"A": (40.3, 50.75), "B": (160.4, 61.2), "C": (100.25, 140.6)}  # px
SIZE = (240, 200)  # px, width and height
RIG = ROOT / "sample_runs" / "huo2015" / "rig.yaml"


def photo(path, bits=8, darker=False):
    """A picture with a mark at each of PLACES."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    light = sum(150 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 1.8**2)) for x, y in PLACES.values())
    grey = (210 - light if darker else 20 + light) + np.random.default_rng(1).normal(0, 1, u.shape)
    kind = np.uint8 if bits == 8 else np.uint16
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.clip(grey * (1 if bits == 8 else 250), 0, None).astype(kind))
    return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    one = Browser(tmp_path_factory.mktemp("downloads"))
    yield one
    one.close()


def place(browser, u, v):
    """Where a pixel of the picture is in the window, from the page's own box and the size of the picture."""
    x, y, wide, high = browser.box("#photo")
    scale = min((wide - 2) / SIZE[0], (high - 2) / SIZE[1])
    return x + wide / 2 + scale * (u + 0.5 - SIZE[0] / 2), y + high / 2 + scale * (v + 0.5 - SIZE[1] / 2)


def table_of(browser, name="points.csv"):
    browser.click_on("#save")
    return list(csv.DictReader(io.StringIO(browser.download(name).decode())))


def opened(browser, page, *size):
    browser.open(page.as_uri(), *size)
    browser.until("document.getElementById('under') && document.getElementById('count').textContent")
    browser.get("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")


def said(browser):
    return browser.get("document.getElementById('said').textContent")


def shown(browser, folder):
    """Mean grey value of the middle of the picture as it is drawn."""
    browser.get("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")
    browser.screenshot(folder / "shot.png")
    x, y = np.round(place(browser, SIZE[0] / 2, SIZE[1] / 2)).astype(int)
    return cv2.imread(str(folder / "shot.png"), cv2.IMREAD_GRAYSCALE)[y - 30 : y + 30, x - 30 : x + 30].mean()


@needs_chromium
def test_points_are_clicked_named_downloaded_and_still_there_after_a_reload(tmp_path, browser):
    survey = tmp_path / "survey.csv"
    survey.write_text("point,x_m,y_m,z_m\nA,0,0,0\nB,1,0,0\nC,0,1,0\n")
    page = tmp_path / "pick.html"
    write_pick_page([f"left={photo(tmp_path / 'l0.png', 16)}"], page, PickOptions(names=survey))
    opened(browser, page)
    browser.click(*place(browser, *np.add(PLACES["A"], 2)))  # a hand is not exact
    browser.type("A")
    browser.press("Enter")
    browser.click(*place(browser, *PLACES["B"]))
    browser.click_on("#choices button")  # A is used: the first one left is B
    rows = table_of(browser)
    assert [(r["camera"], r["point"]) for r in rows] == [("left", "A"), ("left", "B")]
    for row in rows:
        assert np.hypot(*np.subtract([float(row["u_px"]), float(row["v_px"])], PLACES[row["point"]])) < 0.05
        assert 0.001 < float(row["sigma_px"]) < 0.05
    browser.reload()
    browser.until("document.getElementById('count')?.textContent.startsWith('2 named')")
    assert "2 names of your last visit" in said(browser)
    assert table_of(browser) == rows
    path = tmp_path / "points.csv"
    path.write_text("camera,point,u_px,v_px,sigma_px\n" + "\n".join(",".join(r.values()) for r in rows) + "\n")
    assert read_observations([path], {"left": SIZE}, ["A", "B", "C"]).point == ("A", "B")
    assert browser.console == []


@needs_chromium
def test_the_picture_is_moved_zoomed_and_stretched_and_points_still_lie_where_they_are_drawn(tmp_path, browser):
    page = tmp_path / "pick.html"
    write_pick_page([str(photo(tmp_path / "left" / "7.png"))], page)
    opened(browser, page)
    fixed = place(browser, *PLACES["C"])
    browser.mouse("mouseMoved", *fixed)
    for _ in range(4):
        browser.mouse("mouseWheel", *fixed, deltaX=0, deltaY=-120)  # about the mouse: C stays
    assert "grey value" in browser.get("document.getElementById('under').textContent")
    browser.mouse("mousePressed", *fixed, button="left", clickCount=1)
    browser.mouse("mouseMoved", fixed[0] + 90, fixed[1] - 60, button="left", buttons=1)
    browser.mouse("mouseReleased", fixed[0] + 90, fixed[1] - 60, button="left", clickCount=1)
    browser.click(fixed[0] + 90, fixed[1] - 60)
    assert "Detected point at (100.2" in said(browser)
    browser.type("C")
    browser.press("Enter")
    before = shown(browser, tmp_path)
    browser.get("(e => (e.value = 25, e.dispatchEvent(new Event('input'))))(document.getElementById('white'))")
    assert shown(browser, tmp_path) > before + 40
    assert [r["point"] for r in table_of(browser)] == ["C"]
    assert browser.console == []


@needs_chromium
def test_keys_alone_name_all_points_and_a_place_without_a_point_can_be_named(tmp_path, browser):
    page = tmp_path / "pick.html"
    write_pick_page([f"left={photo(tmp_path / 'l.png', darker=True)}"], page, PickOptions(darker=True))
    opened(browser, page, 420, 900, True)
    assert browser.get("document.documentElement.scrollWidth <= innerWidth")
    browser.get("document.getElementById('photo').focus()")
    for name in ("first", "second", "third"):
        browser.press("n")
        browser.press("Enter")
        browser.type(name)
        browser.press("Enter")
    browser.press("n")
    assert said(browser) == "All detected points have a name."
    browser.click(*place(browser, 200, 180))
    assert "a place read by eye" in said(browser)
    browser.type("=A1")
    browser.press("Enter")
    assert "formula" in said(browser)
    browser.get("document.getElementById('name').value = ''")
    browser.type("first")  # a name is there once: it moves
    browser.press("Enter")
    assert "it is moved here" in said(browser)
    rows = table_of(browser)
    assert [r["point"] for r in rows] == ["first", "second", "third"]
    assert [abs(float(rows[0][c]) - x) < 3 for c, x in (("u_px", 200), ("v_px", 180))] == [True, True]
    assert float(rows[0]["sigma_px"]) >= 0.2
    found = {(round(float(r["u_px"])), round(float(r["v_px"]))) for r in rows[1:]}
    assert found < {(round(u), round(v)) for u, v in PLACES.values()}
    browser.click_on("#list button[aria-label='Remove second']")
    assert [r["point"] for r in table_of(browser)] == ["first", "third"]
    assert browser.console == []


@needs_chromium
def test_tables_are_read_back_unchanged_also_rows_of_pictures_that_are_not_shown(tmp_path, browser):
    text = "frame,camera,spot,u_px,v_px,sigma_px\n4,left,2,160.4000,61.2000,0.02\n9,right,5,11.5000,12.2500,0.2\n"
    (tmp_path / "spots.csv").write_text(text)
    options = PickOptions(names=RIG, table=tmp_path / "spots.csv")
    write_pick_page([f"left={photo(tmp_path / 'l4.png')}"], tmp_path / "pick.html", options)
    opened(browser, tmp_path / "pick.html")
    assert "2 names read, 1 of them of pictures that are not shown" in said(browser)
    browser.click_on("#save")
    assert browser.download("spots.csv").decode() == text
    browser.click(*place(browser, *PLACES["A"]))
    assert browser.get("[...document.querySelectorAll('#choices button')].map(b => b.textContent)") == ["1", "3"]
    browser.click_on("#choices button")
    rows = table_of(browser, "spots.csv")
    assert [(r["frame"], r["camera"], r["spot"]) for r in rows] == [
        ("4", "left", "1"),
        ("4", "left", "2"),
        ("9", "right", "5"),
    ]
    path = tmp_path / "again.csv"
    path.write_text(",".join(rows[0]) + "\n" + "\n".join(",".join(r.values()) for r in rows) + "\n")
    assert len(read_spot_table(path, load_rig(RIG), []).pixels) == 3
    (tmp_path / "points.csv").write_text('camera,point,u_px,v_px\r\nleft,"x, ""y""",100.2500,140.6000\r\n')
    file = browser.send("DOM.querySelector", nodeId=browser.send("DOM.getDocument")["root"]["nodeId"], selector="#file")
    browser.send("DOM.setFileInputFiles", files=[str(tmp_path / "points.csv")], nodeId=file["nodeId"])
    browser.until("document.getElementById('kind').value === 'point'")
    assert [(r["point"], r["sigma_px"]) for r in table_of(browser)] == [('x, "y"', "0.2")]
    (tmp_path / "wrong.csv").write_text("camera,point,u,v\nleft,A,1,2\n")
    browser.send("DOM.setFileInputFiles", files=[str(tmp_path / "wrong.csv")], nodeId=file["nodeId"])
    browser.until("document.getElementById('said').textContent.startsWith('wrong.csv: expected a column u_px')")
    assert browser.console == []


def test_the_page_loads_nothing_and_has_the_points_of_every_picture(tmp_path):
    for number in (3, 4):
        photo(tmp_path / "left" / f"{number}.png")
    done = write_pick_page([str(tmp_path / "left")], tmp_path / "pick.html")
    assert done.line().startswith("6 points in 2 pictures")
    text = (tmp_path / "pick.html").read_text()
    assert "http" not in text.replace("http-equiv", "").replace("https://www.w3.org", "")
    assert '"camera":"left","frame":3' in text


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("camera,point,u_px\nleft,A,3\n", "expected a column 'v_px'"),
        ("camera,name,u_px,v_px\nleft,A,3,4\n", "expected columns camera,point,u_px,v_px or frame,camera,spot"),
    ],
)
def test_a_table_without_the_columns_of_the_contract_is_refused(tmp_path, content, words):
    (tmp_path / "points.csv").write_text(content)
    options = PickOptions(table=tmp_path / "points.csv")
    with pytest.raises(InputError, match=words):
        write_pick_page([str(photo(tmp_path / "l.png"))], tmp_path / "p.html", options)


@pytest.mark.parametrize(
    ("given", "cameras"),
    [
        (["{0}/a/l3.png"], ["l3 3"]),
        (["{0}/a/l3.png", "{0}/a/l5.png"], ["a 3", "a 5"]),
        (["{0}/a", "{0}/b/r1.png"], ["a 3", "a 5", "r1 1"]),
        (["left={0}/a/l3.png", "right={0}/b/r1.png", "left={0}/a/l5.png"], ["left 3", "left 5", "right 1"]),
    ],
)
def test_pictures_belong_to_the_camera_that_is_stated_or_to_that_of_their_folder(tmp_path, given, cameras):
    for name in ("a/l3.png", "a/l5.png", "b/r1.png"):
        photo(tmp_path / name)
    write_pick_page([g.format(tmp_path) for g in given], tmp_path / "pick.html")
    text = (tmp_path / "pick.html").read_text()
    assert re.findall(r'"label":"(.*?)"', text) == cameras


def test_more_pictures_than_a_page_holds_are_refused(tmp_path):
    folder = tmp_path / "left"
    for number in range(MOST_PICTURES + 1):
        photo(folder / f"{number}.png") if number == 0 else (folder / f"{number}.png").hardlink_to(folder / "0.png")
    with pytest.raises(InputError, match=f"at most {MOST_PICTURES} pictures"):
        write_pick_page([str(folder)], tmp_path / "p.html")
