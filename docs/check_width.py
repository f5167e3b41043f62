# Licensed under a 3-clause BSD style license - see LICENSE
"""
Is a page of the documentation wider than its window? Run in Chromium after a build.

``python docs/check_width.py docs/_build/html 400 1280`` opens every page at these widths, in
pixels, and names those in which something sticks out that no box of its own scrolls.
"""

import asyncio
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.request import urlopen

from tornado.websocket import websocket_connect

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PORT = 9333
# the table of contents of a narrow window waits outside of it
STICKS_OUT = """(() => {
  const width = document.documentElement.clientWidth, wide = [];
  const scrolls = (element) => {
    while ((element = element.parentElement))
      if (/auto|scroll|hidden/.test(getComputedStyle(element).overflowX)) return true;
    return false;
  };
  for (const element of document.querySelectorAll("main *")) {
    const box = element.getBoundingClientRect();
    if (box.width && box.right > width + 1 && !element.closest(".bd-sidebar-secondary")
        && !scrolls(element))
      wide.push(`${element.tagName} ${Math.round(box.right)} ${element.textContent.slice(0, 40)}`);
  }
  return wide.slice(0, 3);
})()"""


class Window:
    """A window of the browser, by the protocol of its developer tools."""

    def __init__(self, socket):
        self.socket, self.number, self.events = socket, 0, []

    async def send(self, method, **params):
        """Return the answer to a command."""
        self.number += 1
        await self.socket.write_message(
            json.dumps({"id": self.number, "method": method, "params": params})
        )
        return await self._until(lambda message: message.get("id") == self.number)

    async def _until(self, wanted):
        while True:
            message = json.loads(await asyncio.wait_for(self.socket.read_message(), 30))
            self.events.append(message.get("method"))
            if wanted(message):
                return message

    async def wide(self, page):
        """Return what sticks out of a page."""
        self.events.clear()
        await self.send("Page.navigate", url=page.resolve().as_uri())
        if "Page.loadEventFired" not in self.events:
            await self._until(lambda message: message.get("method") == "Page.loadEventFired")
        # formulae are drawn after the page is loaded
        drawn = {"expression": "window.MathJax?.startup.promise.then(() => 0)"}
        await self.send("Runtime.evaluate", awaitPromise=True, **drawn)
        answer = await self.send("Runtime.evaluate", expression=STICKS_OUT, returnByValue=True)
        return answer["result"]["result"]["value"]


async def address():
    """Return the address of the first window, once the browser has one."""
    for _ in range(100):
        try:
            with urlopen(f"http://127.0.0.1:{PORT}/json/list", timeout=5) as stream:
                return json.load(stream)[0]["webSocketDebuggerUrl"]
        except (OSError, IndexError):
            await asyncio.sleep(0.2)
    raise SystemExit("check_width: the browser does not start")


async def check(pages, widths):
    """Return lines that name the pages which are too wide."""
    window, wrong = Window(await websocket_connect(await address())), []
    await window.send("Page.enable")
    for width in widths:
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        await window.send("Emulation.setDeviceMetricsOverride", **size)
        for page in pages:
            wrong += [f"{width} px: {page}: {what}" for what in await window.wide(page)]
    return wrong


def main(folder, *widths):
    """Open all pages of a folder."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise SystemExit(f"check_width: none of {', '.join(BROWSERS)} is installed")
    names = {page: page.relative_to(folder).parts for page in sorted(Path(folder).rglob("*.html"))}
    pages = [page for page, parts in names.items() if not any(p.startswith("_") for p in parts)]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
        options += [f"--remote-debugging-port={PORT}", "--host-resolver-rules=MAP * ~NOTFOUND"]
        started = subprocess.Popen([browser, *options], stderr=subprocess.DEVNULL)
        try:
            wrong = asyncio.run(check(pages, list(map(int, widths)) or [400, 1280]))
        finally:
            started.terminate()
            started.wait()
    print("\n".join([*wrong, f"{len(pages)} pages, {len(wrong)} times too wide"]))
    raise SystemExit(bool(wrong or not pages))


if __name__ == "__main__":
    main(*sys.argv[1:])
