"""Headless Chromium for tests, driven through its DevTools pipe: real mouse events, keys, downloads and screenshots."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
KEYS = {"Enter": 13, "Escape": 27, "Delete": 46, "Tab": 9, "ArrowLeft": 37, "ArrowUp": 38}
_LIMIT_S = 60.0


class Browser:
    """One page. Coordinates are CSS pixels of the window; messages of the console and errors are kept."""

    def __init__(self, downloads: Path) -> None:
        self.console: list[str] = []
        self.downloads = downloads
        self._profile = tempfile.TemporaryDirectory(prefix="beampose-chromium-", ignore_cleanup_errors=True)
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        # DevTools reads descriptor 3 and writes descriptor 4.
        pipes = f'exec 3<&{to_read} 4>&{to_write}; exec "$@"'
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--no-first-run"]
        command = ["bash", "-c", pipes, "bash", str(CHROMIUM), *options, f"--user-data-dir={self._profile.name}"]
        self._process = subprocess.Popen(
            command, pass_fds=(to_read, to_write), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(to_read)
        os.close(to_write)
        self._buffer, self._number, self._session, self._downloads_done = b"", 0, None, 0
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")
        self.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(downloads), eventsEnabled=True)

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._write)
        os.close(self._read)
        self._profile.cleanup()

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None and not method.startswith(("Target.", "Browser.")):
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._message()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def _message(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            assert select.select([self._read], [], [], _LIMIT_S)[0], "Chromium does not answer"
            self._buffer += os.read(self._read, 1 << 20)
        text, _, self._buffer = self._buffer.partition(b"\0")
        message = json.loads(text)
        known = message.get("params", {})
        if message.get("method") == "Runtime.exceptionThrown":
            self.console.append(str(known["exceptionDetails"].get("exception", {}).get("description")))
        elif message.get("method") == "Runtime.consoleAPICalled":
            self.console.append(" ".join(str(a.get("value")) for a in known["args"]))
        elif message.get("method") == "Log.entryAdded":
            self.console.append(known["entry"]["text"])
        elif message.get("method") == "Browser.downloadProgress":
            self._downloads_done += known["state"] == "completed"
        return message

    def open(self, address: str, width: int = 1200, height: int = 800, night: bool = False) -> None:
        """Open a page in a window of this size, with the colours of the day or of the night."""
        self.size(width, height, night)
        self.console.clear()
        self.send("Page.navigate", url=address)
        self.until("document.readyState === 'complete'")

    def reload(self) -> None:
        """Load the page once more; a question asked right after the command would still be answered by the old one."""
        self.get("window.isBeforeReload = true")
        self.send("Page.reload")
        self.until("!window.isBeforeReload && document.readyState === 'complete'")

    def _state(self) -> str:
        shown = self.get("[location.href, document.readyState, document.body?.innerText.slice(0, 500)].join(' | ')")
        return f"console: {self.console}; page: {shown}"

    def size(self, width: int, height: int, night: bool = False) -> None:
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        name, value = ("prefers-color-scheme: dark" if night else "prefers-color-scheme: light").split(": ")
        self.send("Emulation.setEmulatedMedia", features=[{"name": name, "value": value}])

    def get(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        done = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done
        return done["result"].get("value")

    def until(self, expression: str, limit_s: float = _LIMIT_S) -> Any:
        """The value of an expression as soon as it is true."""
        end = time.monotonic() + limit_s
        while not (value := self.get(expression)):
            assert time.monotonic() < end, f"not true after {limit_s} s: {expression}; {self._state()}"
            time.sleep(0.03)
        return value

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> None:
        """A click of the left button at a place of the window."""
        self.mouse("mouseMoved", x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1)

    def click_on(self, selector: str) -> None:
        """A click on the middle of an element, which is scrolled into the window."""
        self.get(f"document.querySelector({selector!r}).scrollIntoView({{block: 'nearest'}})")
        x, y, wide, high = self.box(selector)
        self.click(x + wide / 2, y + high / 2)

    def box(self, selector: str) -> list[float]:
        """Left, top, width and height of an element in the window."""
        box = f"document.querySelector({selector!r}).getBoundingClientRect()"
        found: list[float] = self.get(f"(b => [b.x, b.y, b.width, b.height])({box})")
        return found

    def type(self, text: str) -> None:
        """Type a text where the focus is."""
        for letter in text:
            self.send("Input.dispatchKeyEvent", type="keyDown", text=letter, key=letter)
            self.send("Input.dispatchKeyEvent", type="keyUp", key=letter)

    def press(self, key: str) -> None:
        """Press a key: a letter, or one of KEYS."""
        if key not in KEYS:
            return self.type(key)
        more = {"text": "\r"} if key == "Enter" else {}
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=KEYS[key], **more)
        return None

    def download(self, name: str) -> bytes:
        """A file that the page has downloaded; it is removed.

        Chromium first reserves the name with an empty file: a file of that name is not yet the content.
        """
        while not self._downloads_done:
            self._message()
        self._downloads_done -= 1
        file = self.downloads / name
        content = file.read_bytes()
        file.unlink()
        return content

    def screenshot(self, path: Path, whole: bool = False) -> None:
        done = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(done["data"]))
