"""A headless Chromium, driven over two pipes by the DevTools protocol: no port, no driver program, no network."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import io
import json
import os
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
FLAGS = (
    "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--hide-scrollbars", "--force-device-scale-factor=1", "--window-size=1200,1000",
    "--host-resolver-rules=MAP * ~NOTFOUND", "--remote-debugging-pipe",
)  # fmt: skip
PATIENCE = 60.0
STARTS = 3


class Browser:
    """One page of a browser of its own, with an empty profile.

    Attributes:
        requests: addresses that the page asked for.
        complaints: errors that the page or the browser logged.
    """

    def __init__(self, profile: Path, *flags: str):
        self._flags = flags
        for attempt in range(STARTS):  # a browser now and then ends before it answers, on a busy machine
            self._start(profile.with_name(f"{profile.name}-{attempt}"))
            try:
                pages = [t for t in self.ask("Target.getTargets")["targetInfos"] if t["type"] == "page"]
                break
            except OSError as error:
                self.close()
                said = self._log.read_text("utf-8", "replace")[-2000:]
                ended = OSError(f"{error}, with status {self._process.returncode}, and said: {said}")
                if attempt + 1 == STARTS:
                    raise ended from error
        self._session = self.ask("Target.attachToTarget", targetId=pages[0]["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.ask(f"{domain}.enable")

    def _start(self, profile: Path) -> None:
        assert PROGRAM is not None
        to_browser, self._to = os.pipe()
        self._from, from_browser = os.pipe()
        # The protocol's pipes are file descriptors 3 and 4, put there by a program that becomes the browser.
        theirs = tuple(fcntl.fcntl(end, fcntl.F_DUPFD, 100) for end in (to_browser, from_browser))
        become = (
            f"import os, sys; os.dup2({theirs[0]}, 3); os.dup2({theirs[1]}, 4); os.execv(sys.argv[1], sys.argv[1:])"
        )
        browser = [PROGRAM, *FLAGS, f"--user-data-dir={profile}", *self._flags, "about:blank"]
        self._log = profile.with_name(f"{profile.name}.log")
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", become, *browser],
                pass_fds=theirs,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=log,
            )
        for end in (to_browser, from_browser, *theirs):
            os.close(end)
        self._rest, self._last = b"", 0
        self._session: str | None = None
        self.requests: list[str] = []
        self.complaints: list[str] = []

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and wait for its answer."""
        self._last += 1
        message: dict[str, Any] = {"id": self._last, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._last:
                assert "error" not in answer, answer["error"]
                return answer["result"]
            self._note(answer)

    def open(self, address: str, *, dark: bool = False, calm: bool = True) -> str:
        """Go to an address and wait until the view is there or has been given up; returns which."""
        features = [
            {"name": "prefers-color-scheme", "value": "dark" if dark else "light"},
            {"name": "prefers-reduced-motion", "value": "reduce" if calm else "no-preference"},
        ]
        self.ask("Emulation.setEmulatedMedia", features=features)
        self.ask("Page.navigate", url="about:blank")
        self.ask("Page.navigate", url=address)
        return self.wait_for("document.documentElement?.dataset.viewer")

    def run(self, code: str) -> Any:
        """Return the value of an expression in the page."""
        answer = self.ask("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, code: str) -> Any:
        """Wait until an expression is true; returns its value."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            value = self.run(code)
            if value:
                return value
            time.sleep(0.05)
        raise TimeoutError(f"never true: {code}; {self.complaints}")

    def picture(self, selector: str) -> np.ndarray:
        """Return a picture of an element, colours from 0 to 1, shape [H, W, 3]."""
        frames = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
        self.run(frames)
        # A frame asked for is not yet one drawn: wait for the drawing, then for its showing.
        self.run("document.querySelectorAll('canvas').forEach(c => c.getContext('webgl2')?.finish())")
        self.run(frames)
        clip = self.run(
            f"(r => ({{x: r.x + scrollX, y: r.y + scrollY, width: r.width, height: r.height, scale: 1}}))"
            f"(document.querySelector({json.dumps(selector)}).getBoundingClientRect())"
        )
        shot = self.ask("Page.captureScreenshot", format="png", clip=clip, captureBeyondViewport=True)["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB")) / 255.0

    def close(self) -> None:
        """End the browser and wait for it."""
        with contextlib.suppress(OSError, AssertionError, TimeoutError):
            self._session = None
            self.ask("Browser.close")
        for end in (self._to, self._from):
            os.close(end)
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _next(self) -> dict[str, Any]:
        end = time.monotonic() + PATIENCE
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._from], [], [], max(end - time.monotonic(), 0.0))
            if not ready:
                raise TimeoutError("the browser does not answer")
            part = os.read(self._from, 1 << 20)
            if not part:
                raise OSError("the browser has gone")
            self._rest += part
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def _note(self, event: dict[str, Any]) -> None:
        given = event.get("params", {})
        if event.get("method") == "Network.requestWillBeSent":
            self.requests.append(given["request"]["url"][:200])
        elif event.get("method") == "Runtime.exceptionThrown":
            self.complaints.append(given["exceptionDetails"].get("exception", {}).get("description", "exception"))
        elif event.get("method") == "Log.entryAdded" and given["entry"]["level"] == "error":
            self.complaints.append(given["entry"]["text"])
