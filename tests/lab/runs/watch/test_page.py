"""The live page of `watch`: what it shows in a browser, who may read it, and that no browser holds up the recording."""

from __future__ import annotations

import json
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import yaml

from lab.errors import InputError
from lab.findings.finding import Level
from lab.runs.watch.board import PageServer, exposure_advice
from lab.runs.watch.live_frames import WatchOptions
from lab.runs.watch.watch import watch_run
from lab.simulate.write import simulate
from tests.lab.chromium import Browser, needs_chromium

FRAMES = 40


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run whose cameras are replayed pictures."""
    # At 10 Hz, so that a busy machine keeps up: pictures of frames that are far behind are shown without labels.
    folder = simulate("smooth", tmp_path_factory.mktemp("run") / "run", seed=3, frames=FRAMES, scale=0.25)
    content = yaml.safe_load((folder / "run.yaml").read_text())
    content["frame_rate_hz"] = 10.0
    for camera in content["cameras"].values():
        camera["device"] = f"replay:{folder / camera.pop('frames')}"
    (folder / "run.yaml").write_text(yaml.safe_dump(content))
    return folder


class Watched:
    """A watch in a thread, with its page."""

    def __init__(self, run: Path, out: Path, page: str | None = "0") -> None:
        self.lines, self.stop, self.outcome = [], threading.Event(), None
        self._thread = threading.Thread(target=self._watch, args=(run, out, page))
        self._thread.start()

    def _watch(self, run, out, page):
        options = WatchOptions(idle_s=5.0, timeout_s=0.5)
        self.outcome = watch_run(run, out, page=page, options=options, stop=self.stop, line=self.lines.append)

    def line(self, number: int) -> str:
        """A line on the terminal, waited for."""
        end = time.monotonic() + 60
        while len(self.lines) <= number:
            assert time.monotonic() < end
            time.sleep(0.02)
        return self.lines[number]

    @property
    def url(self) -> str:
        return self.line(0).removeprefix("page: ")

    def end(self):
        self.stop.set()
        self._thread.join(60)
        return self.outcome


@needs_chromium
def test_the_page_shows_pictures_labels_exposure_and_poses_until_the_recording_ends(run, tmp_path):
    watched = Watched(run, tmp_path / "out")
    browser = Browser(tmp_path)
    try:
        browser.open(watched.url)
        browser.until("Number(document.getElementById('frames').textContent) > 12")
        labelled = "c => /^[0-9]$/.test(c.querySelector('tbody td')?.textContent)"
        browser.until(f"[...document.querySelectorAll('.camera')].every({labelled})")
        for camera in (1, 2):
            row = browser.get(
                f"[...document.querySelector('.camera:nth-child({camera}) tbody tr').cells].map(c => c.textContent)"
            )
            assert all(float(cell.split()[0]) > 0 for cell in row[1:])
            assert "spot" in browser.get(f"document.querySelector('.camera:nth-child({camera}) .advice').textContent")
        drawn = "(c => new Set(c.getContext('2d').getImageData(0, 0, c.width, c.height).data).size)"
        browser.until(f"{drawn}(document.querySelector('.camera canvas')) > 20")
        assert browser.get("document.getElementById('pose').textContent") == "measured"
        assert " ± " in browser.get("document.querySelector('#curves figcaption').textContent")
        browser.until("document.getElementById('words').textContent.includes('last seconds')")
        for width in (420, 1200):
            browser.size(width, 800, night=True)
            assert browser.get("document.documentElement.scrollWidth <= innerWidth")
        assert [line for line in browser.console if "readback" not in line] == []
        watched.line(1)  # the first of status comes a second after the first frame
        outcome = watched.end()
        browser.until("document.getElementById('state').textContent.startsWith('The recording has ended')")
    finally:
        watched.stop.set()
        browser.close()
    assert outcome.result.frames > 12
    said = re.fullmatch(
        r"(\d+) s: (\d+) frames, (\d+) measured, latency [\d.]+ ms \(largest [\d.]+ ms\)", watched.lines[-1]
    )
    assert int(said[3]) > 0.5 * int(said[2])


def get(url: str, **headers: str) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10) as answer:
            return answer.status, answer.read(200)
    except urllib.error.HTTPError as error:
        return error.code, b""


def server(state=lambda over: json.dumps({"over": over}), address="0") -> PageServer:
    return PageServer(address, "<html>", state, lambda name: (b"jpeg", {"marks": [name]}) if name == "left" else None)


def test_without_a_host_only_this_computer_reads_the_page_and_no_other_site_can():
    with server() as page:
        assert page.url.startswith("http://127.0.0.1:")
        port = page.url.split(":")[-1]
        assert get(page.url) == (200, b"<html>")
        assert get(f"{page.url}picture?camera=left") == (200, b"jpeg")
        assert get(f"{page.url}picture?camera=other")[0] == 204
        assert get(f"{page.url}other")[0] == 404
        assert get(page.url, Host=f"localhost:{port.strip('/')}")[0] == 200
        assert get(page.url, Host="attacker.example")[0] == 403  # a name that was bound to 127.0.0.1 afterwards
    with pytest.raises(urllib.error.URLError):
        get(page.url)


def test_with_a_host_the_page_needs_its_token():
    with server(address="0.0.0.0:0") as page:
        port, token = re.fullmatch(r"http://.*:(\d+)/\?token=(.{20,})", page.url).groups()
        base = f"http://127.0.0.1:{port}"
        for path in ("/", "/state", "/picture?camera=left"):
            assert get(base + path)[0] == 403
            assert get(f"{base}{path}{'&' if '?' in path else '?'}token={token[:-1]}")[0] == 403
        assert get(f"{base}/?token={token}") == (200, b"<html>")


@pytest.mark.parametrize("address", ["here", "127.0.0.1:", "70000", "nowhere.invalid:80"])
def test_an_address_that_cannot_be_used_is_named(address):
    with pytest.raises(InputError, match="--page: "):
        server(address=address)


@pytest.mark.slow
def test_a_browser_that_reads_nothing_holds_up_nobody_and_a_late_one_gets_the_newest_state():
    made = []

    def state(over):
        made.append(time.monotonic())
        return json.dumps({"number": len(made), "filler": "x" * 1_000_000, "over": over})

    with server(state) as page:
        port = int(page.url.split(":")[-1].strip("/"))
        stalled = socket.create_connection(("127.0.0.1", port))
        stalled.sendall(b"GET /state HTTP/1.1\r\nHost: localhost\r\n\r\n")
        time.sleep(1.5)
        few = len(made)  # its thread waits: nothing is made for it, nothing queues up
        assert few < 12
        with urllib.request.urlopen(f"{page.url}state", timeout=10) as late:
            first = json.loads(late.readline()[6:])
            late.readline()
            time.sleep(0.6)
            assert first["number"] == few + 1
        stalled.close()


@pytest.mark.parametrize(
    ("peaks", "background", "words", "level"),
    [
        ([], 0.02, "no point found", Level.FAIL),
        ([0.4, 0.95], 0.02, "1 of 2 spots clipped: halve the exposure", Level.FAIL),
        ([0.1, 0.13], 0.02, "brightest spot at 13 % of the range: expose 5.0 times as long", Level.WARN),
        ([0.5, 0.6], 0.4, "background at 40 % of the range", Level.WARN),
        ([0.5, 0.6], 0.02, "brightest spot at 60 % of the range: good", Level.PASS),
    ],
)
def test_the_advice_on_exposure_says_what_to_change(peaks, background, words, level):
    advice, found = exposure_advice(np.array(peaks), background, 2)
    assert advice.startswith(words)
    assert found == level
