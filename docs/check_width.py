# Licensed under a 3-clause BSD style license - see LICENSE
"""
Whether pages of a built site scroll sideways: ``python docs/check_width.py HTML``.

Every page is opened in a headless Chromium at the widths of a telephone and of a small desktop.
What is wider than the page without a scroll bar of its own is listed.
"""

import functools
import html
import json
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

WIDTHS = (400, 1280)
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PROBE = "_width.html"
_PAGE = """<!doctype html><body><script>
const pages = %s, width = %d, found = {};
(async () => {
  for (const page of pages) {
    const frame = document.createElement("iframe");
    frame.style = `width: ${width}px; height: 800px; border: 0`;
    frame.src = page;
    await new Promise((done) => { frame.onload = done; document.body.append(frame); });
    const root = frame.contentDocument.documentElement;
    const wide = [...frame.contentDocument.querySelectorAll(".bd-article *")].filter(
      (one) => one.getBoundingClientRect().right > width + 1);
    found[page] = [root.scrollWidth, wide.slice(0, 3).map((one) => `${one.tagName}.${one.className}`)];
    frame.remove();
  }
  document.body.textContent = "found" + JSON.stringify(found) + "end";
})();
</script>"""


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


def widths(root, pages, width):
    """Return the width of each page, and what is wide in it, in a window of a width (px)."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise SystemExit(f"no browser: none of {', '.join(BROWSERS)} is installed")
    server = ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(_Quiet, directory=str(root))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    (root / PROBE).write_text(_PAGE % (json.dumps(pages), width), encoding="utf-8")
    try:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
            command += [f"--user-data-dir={profile}", "--virtual-time-budget=600000"]
            command += [f"--window-size={width + 40},900"]
            command += [f"http://127.0.0.1:{server.server_port}/{PROBE}"]
            text = subprocess.run(command, capture_output=True, text=True, timeout=600).stdout
    finally:
        (root / PROBE).unlink()
        server.shutdown()
    answer = re.search(r"found(\{.*\})end", text)
    if answer is None:
        raise SystemExit("the browser gave no answer")
    return json.loads(html.unescape(answer[1]))


def main(root):
    """Print the pages that scroll sideways, and return how many."""
    pages = sorted(p.relative_to(root).as_posix() for p in root.rglob("*.html"))
    pages = [page for page in pages if not page.startswith("_")]
    wrong = 0
    for width in WIDTHS:
        for page, (wide, what) in widths(root, pages, width).items():
            if wide > width:
                wrong += 1
                print(f"{page}: {wide} px at {width} px: {', '.join(what)}", file=sys.stderr)
    print(f"{len(pages)} pages at {' and '.join(map(str, WIDTHS))} px, {wrong} scroll sideways")
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(Path(sys.argv[1]).resolve()), 1))
