"""A page in headless Chromium, driven through its DevTools protocol."""

import base64
import io
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path

import numpy as np
from PIL import Image
from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--window-size=1100,700",
    "--remote-debugging-port=0",
)


def program():
    """The path of a browser; None if there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """A page of an address. Use it in a `with` block, which ends the browser."""

    def __init__(self, url, folder):
        self._url, self._folder, self._count = url, Path(folder), 0

    def __enter__(self):
        words = [program(), *FLAGS, f"--user-data-dir={self._folder}", self._url]
        self._process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = until(self._port, 60)
            pages = until(lambda: [p for p in self._pages(port) if p["url"].startswith(self._url)], 30)
            self._socket = connect(pages[0]["webSocketDebuggerUrl"], max_size=None)
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_):
        self._socket.close()
        self._end()

    def _end(self):
        self._process.terminate()
        self._process.wait(30)

    def _port(self):
        file = self._folder / "DevToolsActivePort"
        return file.is_file() and file.read_text().split()[0]

    def _pages(self, port):
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
            return json.loads(answer.read())

    def _call(self, method, **arguments):
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": arguments}))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == self._count:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    def run(self, script):
        """The value of a script's expression on the page."""
        result = self._call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def text(self):
        """The text that is on the page."""
        return self.run("document.body?.innerText") or ""

    def click(self, label):
        """Press the button of this label."""
        find = f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() === {json.dumps(label)})"
        until(lambda: self.run(f"!!({find})"), 30)
        self.run(f"({find}).click()")

    def picture(self):
        """The page as it is seen, (H, W, 3) uint8."""
        data = base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def until(condition, seconds):
    """Wait until a function gives something true, and return it."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.1)
    return found
