"""The site in a real browser, at a phone's width: no console error, nothing wider than the screen,
search finds. Skipped where there is no Chromium.
"""

import functools
import http.server
import json
import pathlib
import queue
import re
import shutil
import subprocess
import threading

import pytest

from tests.benchmarks.test_site import site  # noqa: F401

PHONE = (390, 844)  # [CSS pixels]
# Written at the head of each page by the server, so that it stands before any script of the page.
HOOK = b"""<script>
window.said = [];
addEventListener("error", (e) => said.push(String(e.message || e.target.src)), true);
addEventListener("unhandledrejection", (e) => said.push(String(e.reason)));
console.error = (...x) => said.push(x.join(" "));
</script>"""
# Loads each page into a frame as wide as a phone and writes down what it says and how wide it is.
PROBE = """<!doctype html><iframe id=frame style="width:%dpx;height:%dpx;border:0"></iframe>
<script>
const pages = %s, out = {}, frame = document.getElementById("frame");
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const load = (url) => new Promise((done) => { frame.onload = done; frame.src = url; });
(async () => {
  for (const page of pages) {
    await load(page);
    await wait(50);
    const errors = frame.contentWindow.said, root = frame.contentDocument.documentElement;
    out[page] = {errors, width: root.scrollWidth};
  }
  const found = {};
  for (const word of %s) {
    await load("index.html");
    const input = frame.contentDocument.querySelector(".md-search__input");
    frame.contentDocument.getElementById("__search").click();
    input.focus();
    input.value = word;
    input.dispatchEvent(new Event("input", {bubbles: true}));
    input.dispatchEvent(new KeyboardEvent("keyup", {bubbles: true}));
    for (let i = 0; i < 100 && !frame.contentDocument.querySelector(".md-search-result__item"); i++)
      await wait(100);
    found[word] = frame.contentDocument.querySelectorAll(".md-search-result__item").length;
  }
  return {pages: out, found};
})().catch((e) => ({failed: String(e)})).then(
  (said) => fetch("probe.json", {method: "POST", body: JSON.stringify(said)}));
</script>"""
WORDS = ("kaplan", "cusum", "payload", "gymnasium", "rollback")


BAD = """<body style="width:2000px"><script>console.error("said"); throw Error("thrown")</script>"""


@pytest.fixture(scope="module")
def seen(site, tmp_path_factory):
  browser = shutil.which("chromium") or shutil.which("chromium-browser")
  if not browser:
    pytest.skip("no Chromium")
  said = queue.Queue()

  class Handler(http.server.SimpleHTTPRequestHandler):
    def do_GET(self):
      path = pathlib.Path(self.translate_path(self.path))
      if path.suffix != ".html" or not path.is_file():
        return super().do_GET()
      page = path.read_bytes()
      start = re.search(rb"<head[^>]*>", page)
      at = start.end() if start else 0
      page = page[:at] + HOOK + page[at:]
      self.send_response(200)
      self.send_header("Content-Type", "text/html; charset=utf-8")
      self.send_header("Content-Length", str(len(page)))
      self.end_headers()
      self.wfile.write(page)

    def do_POST(self):
      said.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
      self.send_response(204)
      self.end_headers()

    def log_message(self, *_):
      pass

  pages = sorted(str(p.relative_to(site)) for p in site.rglob("*.html") if p.name != "404.html")
  probe, bad = site / "probe.html", site / "bad.html"
  probe.write_text(PROBE % (*PHONE, json.dumps([*pages, bad.name]), json.dumps(WORDS)))
  bad.write_text(BAD)
  server = http.server.ThreadingHTTPServer(
    ("127.0.0.1", 0), functools.partial(Handler, directory=site)
  )
  threading.Thread(target=server.serve_forever, daemon=True).start()
  process = subprocess.Popen(
    [
      browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
      "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage",
      f"--user-data-dir={tmp_path_factory.mktemp('browser')}",
      f"http://127.0.0.1:{server.server_port}/probe.html",
    ],
    stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
  )  # fmt: skip
  try:
    return said.get(timeout=600)
  finally:
    process.kill()
    process.wait()
    server.shutdown()
    probe.unlink()
    bad.unlink()


def test_the_probe_sees_what_is_wrong(seen):
  bad = seen["pages"]["bad.html"]
  assert bad["width"] >= 2000
  assert "said" in bad["errors"] and any("thrown" in x for x in bad["errors"])


def test_no_page_has_an_error(seen):
  assert len(seen["pages"]) > 60
  assert {page for page, one in seen["pages"].items() if one["errors"]} == {"bad.html"}


def test_every_page_fits_a_phone(seen):
  wide = {page for page, one in seen["pages"].items() if one["width"] > PHONE[0]}
  assert wide == {"bad.html"}


def test_search_finds_in_the_browser(seen):
  assert set(seen["found"]) == set(WORDS) and all(seen["found"].values()), seen["found"]
