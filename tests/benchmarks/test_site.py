"""The site: built strictly, nothing fetched from elsewhere, every link and anchor leads somewhere;
the tutorials run as they stand there, with smaller numbers.
"""

import html.parser
import json
import os
import pathlib
import re
import shlex
import subprocess
import sys
import urllib.parse

import pytest

ROOT = pathlib.Path(__file__).parents[2]
TUTORIALS = ROOT / "docs/tutorials"


class Page(html.parser.HTMLParser):
  """Links, anchors and what is fetched as a page is looked at."""

  def __init__(self, path):
    super().__init__()
    self.links, self.anchors, self.fetched = [], {"", "__search"}, []
    self.feed(path.read_text())

  def handle_starttag(self, tag, attrs):
    own = dict(attrs)
    self.anchors |= {own[key] for key in ("id", "name") if own.get(key)}
    if tag == "a" and own.get("href"):
      self.links.append(own["href"])
    if tag in ("script", "img", "iframe", "source") and own.get("src"):
      self.fetched.append(own["src"])
    if tag == "link" and own.get("rel") in ("stylesheet", "icon", "preload"):
      self.fetched.append(own["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
  pytest.importorskip("mkdocs", reason="the extra [docs] is not installed")
  pytest.importorskip("mkdocstrings", reason="the extra [docs] is not installed")
  folder = tmp_path_factory.mktemp("site")
  done = subprocess.run(
    [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", folder],
    cwd=ROOT, capture_output=True, text=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
  )  # fmt: skip
  assert done.returncode == 0, done.stdout + done.stderr
  return folder


def test_nothing_is_fetched_and_no_link_is_broken(site):
  pages = {
    path: Page(path)
    for path in site.rglob("*.html")
    if path.name not in ("404.html", "leaderboard.html")
    or (path.parent == site and path.name != "404.html")
  }  # the board is no page of the site, and a server alone shows 404.html
  lost = []
  for path, page in pages.items():
    for at in dict.fromkeys([*page.links, *page.fetched]):
      url = urllib.parse.urlsplit(at)
      if url.scheme or url.netloc:
        lost += [f"{path}: fetches {at}"] * (at in page.fetched)
        continue
      target = path if not url.path else (path.parent / urllib.parse.unquote(url.path)).resolve()
      if target.is_dir():
        target /= "index.html"
      known = pages.get(target)
      if not target.exists() or (known and urllib.parse.unquote(url.fragment) not in known.anchors):
        lost.append(f"{path.relative_to(site)}: {at}")
  assert len(pages) > 60 and not lost, "\n".join(lost[:40])


@pytest.mark.parametrize("word", ["kaplan-meier", "cusum", "payload", "gymnasium", "rollback"])
def test_search_finds(site, word):
  docs = json.loads((site / "search/search_index.json").read_text())["docs"]
  assert any(word in (one["title"] + one["text"]).lower() for one in docs)


def test_each_detector_has_its_page_with_equation_and_row(site):
  from benchmarks import build_site

  names = build_site.detectors()
  assert len(names) >= 20 and "cusum" in names
  for name in names:
    text = (site / f"detectors/{name}.html").read_text()
    assert name in text and len(re.sub(r"<[^>]+>", "", text.split("<article")[1])) > 600, name
  assert "false alarms an hour" in (site / "detectors/cusum.html").read_text()


# ---- tutorials -----------------------------------------------------------------------------------

SMALLER = {  # what the tests take in place of what a user does
  "statistics": (
    ("seeds = 10", "seeds = 2"),
    ("steps = 25000", "steps = 448"),
    ("onset = 5000", "onset = 128"),
    ("bench variant.toml", "bench variant.toml --jobs 1"),
  ),
  "detector": (("--detector cusum ewma", "--detector cusum"),),
  "log": (),
}


@pytest.mark.parametrize(
  "name", [*(pytest.param(x, marks=pytest.mark.slow) for x in ("statistics", "detector")), "log"]
)
def test_a_tutorial_runs(name, tmp_path):
  text = (TUTORIALS / f"{name}.md").read_text()
  for old, new in SMALLER[name]:
    assert old in text
    text = text.replace(old, new)
  parts = re.findall(r"(?:`([a-z]+\.(?:py|toml))`:\n\n)?```(sh|python|toml)\n(.*?)```", text, re.S)
  ran = 0
  for file, kind, code in parts:
    if file:
      (tmp_path / file).write_text(code)
    elif kind == "python":
      subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    for line in code.splitlines() if kind == "sh" else ():
      words = shlex.split(line)
      assert words[0] == "mjx-cl"
      done = subprocess.run(
        [sys.executable, "-m", "mjx_cl", *words[1:]], cwd=tmp_path, capture_output=True, text=True
      )
      assert done.returncode == 0, done.stderr[-2000:]
      ran += 1
  assert ran >= 2


def test_the_notebook_runs_and_says_what_it_shows(tmp_path):
  cells = json.loads((ROOT / "docs/notebook.ipynb").read_text())["cells"]
  code = [cell for cell in cells if cell["cell_type"] == "code"]
  shown = "".join(
    "".join(out["text"]) for cell in code for out in cell["outputs"] if out.get("name") == "stdout"
  )
  done = subprocess.run(
    [sys.executable, "-c", "\n".join("".join(cell["source"]) for cell in code)],
    cwd=tmp_path, capture_output=True, text=True, env=os.environ | {"MPLBACKEND": "Agg"},
  )  # fmt: skip
  assert done.returncode == 0, done.stderr[-2000:]
  # scores may differ in the last place that is printed, or a little more, on another machine
  numbers = lambda text: [float(x) for x in re.findall(r"-?\d+(?:\.\d+)?", text)]
  words = lambda text: re.sub(r"[-\d.\s]+", " ", text)
  assert words(done.stdout) == words(shown) and "learnt" in shown
  assert numbers(done.stdout) == pytest.approx(numbers(shown), abs=2, rel=0.02)
