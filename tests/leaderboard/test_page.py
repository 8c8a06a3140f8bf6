"""The leaderboard's page: what is embedded, how it is written, and what a browser shows of it."""

import base64
import errno
import html.parser
import json
import math
import os
import pathlib
import re
import shutil
import urllib.parse

import numpy as np
import pytest

from mjx_cl.errors import FileError, UserError
from mjx_cl.leaderboard import page

REAL = (
  "cusum",
  "page_hinkley",
  "ewma",
  "glr",
  "shiryaev_roberts",
  "mewma",
  "hotelling",
  "adwin",
  "kswin",
  "z_score",
  "rolling_sigma",
  "rolling_sigma_plain",
  "max_variables",
  "surprise",
  "knn",
)
ROBOTS = {"car": 0.05, "quadruped": 0.02, "walker": 0.025}
FAULTS = ("friction", "gear", "joint_lock", "mass", "sensor_bias", "velocity_limit")
SEVERITIES = (0.5, 1.0)
HOSTILE = (
  "</script><b>bold</b></script /<!--<script x"  # an end tag needs no >, a space or a slash will do
)


def around(rng, value, width):
  """Interval about a value."""
  return [value - width * rng.uniform(0.4, 1), value + width * rng.uniform(0.4, 1)]


def synthetic(
  seed=0, detectors=REAL + page.REFERENCES, robots=ROBOTS, faults=FAULTS, severities=SEVERITIES
):
  """Arguments of page.write for a leaderboard drawn by chance; each detector has a skill, each
  fault a difficulty.
  """
  rng = np.random.default_rng(seed)
  skill = {
    d: {"never": 0.0, "always": 0.0, "periodic": 0.1, "random": 0.08, "oracle": 1.0}.get(
      d, 0.93 - 0.04 * i
    )
    for i, d in enumerate(detectors)
  }
  hard = {f: rng.uniform(0.2, 1) for f in faults}
  rows = []
  for d in detectors:
    for robot, control_s in robots.items():
      alarms = int(rng.integers(35, 200))
      for fault in faults:
        for severity in severities:
          found = np.clip(
            skill[d] * (1.3 - hard[fault]) * (0.6 + 0.4 * severity) + rng.normal(0, 0.04), 0, 1
          )
          if d in ("never", "oracle"):
            found = skill[d]
          late = None if found < 0.5 else float(np.round(20 * (1 - found) / control_s))
          score = {"always": -380.0, "never": 0.0, "oracle": 100.0}.get(d, 100 * found - 4)
          scores = {
            "cost_standard": score,
            "cost_few_false": score - 5,
            "cost_few_misses": 0.9 * score - 12 * (d == "cusum"),
          }
          rows.append(
            {
              "detector": d,
              "robot": robot,
              "fault": fault,
              "severity": severity,
              "reward_lost": 0.3 * severity,
              "streams": 10,
              "threshold": rng.uniform(3, 9),
              "arl0": 1e6 / alarms,
              "arl0_ci": [8e5 / alarms, 1.3e6 / alarms],
              "arl0_alarms": alarms,
              "arl0_few": alarms < 50,
              "episode_alarm_probability": rng.uniform(0, 0.1),
              "latency_median_steps": late,
              "latency_median_s": late and late * control_s,
              "latency_median_s_ci": late and [0.8 * late * control_s, None],
              "miss_probability": 1 - found,
              "miss_probability_ci": [max(0.0, 0.9 - found), min(1.0, 1.1 - found)],
              "false_alarms_per_hour": rng.uniform(2, 12),
              "detected_within_0.5s": 0.3 * found,
              "detected_within_1s": 0.5 * found,
              "detected_within_5s": 0.8 * found,
              "detected_within_20s": found,
              "auroc": None if d == "never" else 0.5 + 0.5 * found,
              **scores,
              **{f"{k}_ci": around(rng, v, 8) for k, v in scores.items()},
              "us_per_sample": rng.uniform(0.1, 40),
              "information_nats_per_step": rng.uniform(0, 0.4),
              "optimal_delay_steps": None,
              "oracle_delay_steps": rng.uniform(5, 40),
              "efficiency": rng.uniform(0.1, 1),
              "note": "slow on long windows" if d == "kswin" else "",
            }
          )
  overall, curves = [], {}
  for d in detectors:
    own = [r for r in rows if r["detector"] == d]
    means = {
      k: float(np.mean([r[k] for r in own]))
      for k in (
        "cost_standard",
        "cost_few_false",
        "cost_few_misses",
        "detected_within_1s",
        "detected_within_5s",
        "miss_probability",
      )
    }
    overall.append(
      {
        "detector": d,
        **means,
        "cost_costly": means["cost_standard"] + 10,
        **{f"{k}_ci": around(rng, v, 3) for k, v in means.items() if k.startswith("cost")},
        "mean_rank": float(1 + (len(detectors) - 1) * (1 - skill[d])),
      }
    )
    if d not in ("never", "oracle"):
      rates = np.geomspace(0.05, 300, 12) * rng.uniform(0.8, 1.2)
      curves[d] = {
        robot: [
          {
            "false_alarms_per_hour": float(x),
            "latency_mean_s": float(20 / (1 + (0.4 + 3 * skill[d]) * x**0.5)),
            "detected": float(np.clip(0.2 + 0.13 * np.log10(x / 0.05) + 0.4 * skill[d], 0, 1)),
          }
          for x in rates
        ]
        for robot in robots
      }
  pages, steps, every = [], 2400, 4
  for robot, control_s in robots.items():
    for fault in faults:
      for severity in severities:
        t = np.arange(0, steps, every)
        after = t >= 1200
        channels = {
          "opr": 0.2 + 0.05 * rng.normal(size=t.size) + 0.3 * severity * after,
          "rpr": 0.1 + 0.04 * rng.normal(size=t.size) + 0.1 * after,
          "reward": 0.9 - 0.3 * after * severity + 0.05 * rng.normal(size=t.size),
          "surprise": rng.gamma(4, 1 + after, t.size),
        }
        channels["opr"][100:104] = np.nan
        alarms = {
          d: None
          if rng.uniform() > 0.3 + 0.7 * skill[d]
          else int(1200 + rng.integers(2, 900) * (1.05 - skill[d]))
          for d in detectors
        }
        alarms |= {"always": 1200, "never": None, "oracle": 1200, "periodic": None}
        pages.append(
          {
            "robot": robot,
            "fault": fault,
            "severity": severity,
            "onset": 1200,
            "control_s": control_s,
            "every": every,
            "channels": channels,
            "alarms": alarms,
            "early": {d: k for d, k in (("always", 0), ("periodic", 800)) if d in alarms},
          }
        )
  pages[0] |= {"seed": 0, "target": "left_hip"}
  pages[0]["others"] = [
    {
      "seed": k,
      "target": "right_knee",
      "onset": 1200 + 40 * k,
      "first": 40 * k,
      "every": 8,
      "alarms": {d: 1240 + 60 * k for d in detectors[:3]},
      "channels": {c: v[k::2] for c, v in pages[0]["channels"].items()},
    }
    for k in (1, 2)
  ]
  meta = {
    "command": "mjx-cl leaderboard --seeds 10",
    "seeds": "0 to 9",
    "machine": {"cpu": "two cores", "cores": 2},
    "versions": {"jax": "0.9.2", "mujoco": "3.14.0"},
    "arl0": 10_000,
    "date": "2026-11-21",
    "notes": ["Thresholds were set on seeds 100 to 109."],
    "critical_difference": 2.4,
  }
  return {"rows": rows, "overall": overall, "curves": curves, "faults": pages, "meta": meta}


@pytest.fixture(scope="module")
def board():
  return synthetic()


@pytest.fixture(scope="module")
def file(board, tmp_path_factory):
  path = tmp_path_factory.mktemp("page") / "leaderboard.html"
  page.write(path, **board)
  return path


class Elements(html.parser.HTMLParser):
  """Start tags of a file with their attributes, and the text of the element with id `data`."""

  def __init__(self, text):
    super().__init__()
    self.tags, self.data, self.inside = [], "", False
    self.feed(text)

  def handle_starttag(self, tag, attributes):
    self.tags.append((tag, dict(attributes)))
    self.inside = dict(attributes).get("id") == "data"

  def handle_endtag(self, tag):
    self.inside = False

  def handle_data(self, text):
    self.data += text if self.inside else ""


def embedded(path):
  return json.loads(Elements(path.read_text()).data)


# ---- the file ------------------------------------------------------------------------------------


def test_every_figure_is_embedded(board, file):
  data = embedded(file)
  rows = [dict(zip(data["keys"], values)) for values in data["rows"]]
  assert len(rows) == len(board["rows"]) == 20 * 3 * 6 * 2
  for row, given in zip(rows, board["rows"]):
    for key, value in given.items():
      if isinstance(value, float):
        assert row[key] == pytest.approx(value, rel=1e-5), key  # six digits are embedded
      elif not isinstance(value, list):
        assert row[key] == value, key
  assert (
    data["overall"][0]["detector"] == "cusum"
    and data["meta"]["command"] == "mjx-cl leaderboard --seeds 10"
  )
  assert data["curves"]["glr"]["walker"][3]["detected"] == pytest.approx(
    board["curves"]["glr"]["walker"][3]["detected"], rel=1e-5
  )
  given = board["faults"][0]["channels"]["opr"]
  shown = unpacked(data["faults"][0]["channels"]["opr"])
  np.testing.assert_allclose(shown, given, rtol=2**-11, atol=2**-25 * np.nanmax(np.abs(given)))
  assert np.isnan(shown[100:104]).all()


def unpacked(channel):
  exponent, text = channel
  return 2.0**exponent * np.frombuffer(base64.b64decode(text), "<f2").astype(float)


@pytest.mark.parametrize("size", [0.0, 1e-30, 0.7, 65_504, 65_536, 3e12])
def test_a_stream_of_any_size_is_embedded_to_three_digits(size):
  """Half a last bit of a half float: 2^-11."""
  values = [size, -size / 3, None, 0.0]
  np.testing.assert_allclose(
    unpacked(page.halves(values)), [size, -size / 3, np.nan, 0.0], rtol=2**-11
  )
  assert np.isnan(unpacked(page.halves([None, np.nan]))).all()
  with pytest.raises(UserError, match="a channel is infinite"):
    page.halves([size, np.inf])


def noted(board, **edit):
  """The board with an efficiency above 1, and its reason, in the row of the last detector but the
  references on the first fault.
  """
  row = next(r for r in board["rows"] if r["detector"] == "knn")
  return board | {
    "rows": [
      r | {"efficiency": 1.25, "note": "above 1: it was luckier"} | edit if r is row else r
      for r in board["rows"]
    ]
  }


def test_an_efficiency_above_one_holds_its_note(board, tmp_path):
  """The column says from where on a figure wants the note, and the script reads that."""
  page.write(tmp_path / "x.html", **noted(board))
  data = embedded(tmp_path / "x.html")
  (column,) = [c for c in data["columns"] if c["noted"] is not None]
  assert (
    column["key"] == "efficiency"
    and column["noted"] == 1
    and column["core"]
    and "column.noted" in (page.ASSETS / "leaderboard.js").read_text()
  )
  rows = [dict(zip(data["keys"], values)) for values in data["rows"]]
  assert [r["note"] for r in rows if r["efficiency"] > column["noted"]] == [
    "above 1: it was luckier"
  ]
  with pytest.raises(
    UserError, match="page: row .* of knn: its efficiency is above 1, and no note says why"
  ):
    page.write(tmp_path / "y.html", **noted(board, note=None))


def test_file_loads_nothing(file):
  text = file.read_text()
  assert "http://" not in text and "https://" not in text and "//" + "www" not in text
  for tag, attributes in Elements(text).tags:
    for name in ("src", "srcset", "data", "action", "poster"):
      assert name not in attributes, (tag, attributes)
    if "href" in attributes:
      assert attributes["href"] in ("#", "data:,")
    assert tag not in ("iframe", "img", "object", "embed")
  assert not re.search(
    r"@import|url\(|\bfetch\(|XMLHttpRequest|\bimport\b|innerHTML|\beval\(", text
  )
  policy = next(
    a["content"] for t, a in Elements(text).tags if a.get("http-equiv") == "Content-Security-Policy"
  )
  assert "default-src 'none'" in policy  # the browser refuses what this test might overlook


@pytest.mark.parametrize(
  "text", [HOSTILE, "<!--<script>", "]]>&amp;\u2028", "@JS@ @DATA@", "__proto__"]
)
def test_text_cannot_leave_its_element(text, tmp_path):
  page.write(tmp_path / "x.html", [], [], {}, [], {"notes": text, text: "key"})
  elements = Elements((tmp_path / "x.html").read_text())
  assert json.loads(elements.data)["meta"] == {"notes": text, text: "key"}
  assert not set("<>&") & set(
    elements.data
  )  # browsers end a script at more than Python's parser does
  assert [t for t, _ in elements.tags].count("script") == 2 and "b" not in [
    t for t, _ in elements.tags
  ]


@pytest.mark.parametrize("value", [math.inf, -math.inf, object(), b"x"])
def test_what_json_cannot_say_is_refused_with_its_place(value, tmp_path):
  with pytest.raises(UserError, match="^page: meta: arl0: .*") as error:
    page.write(tmp_path / "x.html", [], [], {}, [], {"arl0": value})
  assert "\n" not in str(error.value) and os.listdir(tmp_path) == []


@pytest.mark.parametrize(
  "part, message",
  [
    ("rows", "row 1 lacks auroc"),
    ("overall", "overall 1 lacks mean_rank"),
    ("faults", "fault 1 lacks onset"),
    ("curves", "curve of glr on walker, point 1 lacks detected"),
  ],
)
def test_missing_key_is_named(part, message, tmp_path):
  board = synthetic(
    detectors=("glr", "ewma"), robots={"walker": 0.025}, faults=("gear",), severities=(0.5, 1.0)
  )
  key = message.split()[-1]
  items = board["curves"]["glr"]["walker"] if part == "curves" else board[part]
  del items[1][key]
  with pytest.raises(UserError, match=message):
    page.write(tmp_path / "x.html", **board)
  assert os.listdir(tmp_path) == []


def test_written_whole_or_not_at_all(tmp_path, monkeypatch):
  path, seen = tmp_path / "x.html", []
  real = os.replace
  monkeypatch.setattr(
    os,
    "replace",
    lambda a, b: (
      seen.append((pathlib.Path(a).name, pathlib.Path(a).read_text()[-8:])),
      real(a, b),
    ),
  )
  page.write(path, [], [], {}, [], {"notes": "first"})
  assert seen == [("x.html.tmp", "</html>\n")] and os.listdir(tmp_path) == [
    "x.html"
  ]  # complete before it gets its name
  before = path.read_bytes()

  def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

  monkeypatch.setattr(os, "replace", full)
  with pytest.raises(FileError, match="cannot write .*No space left.*unchanged"):
    page.write(path, [], [], {}, [], {"notes": "second"})
  assert path.read_bytes() == before and os.listdir(tmp_path) == ["x.html"]
  with pytest.raises(FileError, match="cannot write"):
    page.write(tmp_path / "missing" / "x.html", [], [], {}, [], {})


def test_assets_ship_with_the_package():
  import tomllib

  root = pathlib.Path(page.__file__).parents[1]
  pyproject = root.parent / "pyproject.toml"
  patterns = tomllib.loads(pyproject.read_text())["tool"]["setuptools"]["package-data"]["mjx_cl"]
  shipped = {p for pattern in patterns for p in root.glob(pattern)}
  assert {page.ASSETS / "leaderboard.js", page.ASSETS / "leaderboard.css"} <= shipped


# ---- in a browser --------------------------------------------------------------------------------


class Browser:
  """Headless Chromium on one file."""

  def __init__(self, driver):
    self.driver = driver

  def open(self, file, hash=""):
    """Loads the file anew at a hash; a busy machine's driver can answer before it is there."""
    from selenium.webdriver.support.wait import WebDriverWait

    self.driver.get("about:blank")
    self.driver.get(f"{file.as_uri()}{hash}")
    WebDriverWait(self.driver, 120).until(
      lambda _: self.js("return location.protocol == 'file:' && document.readyState == 'complete'")
    )
    return self

  def all(self, selector):
    from selenium.webdriver.common.by import By

    return self.driver.find_elements(By.CSS_SELECTOR, selector)

  def one(self, selector):
    found = self.all(selector)
    assert len(found) == 1, f"{selector}: {len(found)} elements"
    return found[0]

  def js(self, code, *arguments):
    return self.driver.execute_script(code, *arguments)

  def column(self, table, key):
    """Texts of a column's cells, without intervals and marks."""
    return self.js(
      "return [...document.querySelectorAll(arguments[0])].map(n => n.textContent)",
      f"#{table} tbody [data-key='{key}'] .v",
    )

  def header(self, table, key):
    return self.one(f"#{table} thead th[data-key='{key}']")

  def sort(self, table, key):
    self.js("arguments[0].querySelector('button').click()", self.header(table, key))

  def choose(self, name, value):
    from selenium.webdriver.support.select import Select

    Select(self.one(f"#{name}")).select_by_value(value)

  def hash(self):
    return self.js("return location.hash")

  def complaints(self):
    return [e["message"] for e in self.driver.get_log("browser")]


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
  programs = {name: shutil.which(name) for name in ("chromium", "chromedriver")}
  missing = [name for name, path in programs.items() if path is None]
  if missing:
    pytest.skip(
      f"no {' and no '.join(missing)} on this machine (Debian packages chromium and "
      "chromium-driver)"
    )
  from selenium import webdriver

  options = webdriver.ChromeOptions()
  options.binary_location = programs["chromium"]
  for flag in (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--window-size=1280,900",
    f"--user-data-dir={tmp_path_factory.mktemp('chromium')}",
  ):
    options.add_argument(flag)
  options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
  driver = webdriver.Chrome(
    options=options, service=webdriver.ChromeService(executable_path=programs["chromedriver"])
  )
  yield driver
  driver.quit()


@pytest.fixture
def browser(driver):
  """A browser that must have had nothing to complain of when the test is over."""
  browser = Browser(driver)
  browser.complaints()
  yield browser
  assert browser.complaints() == []


def numbers(texts):
  """Cells as numbers, dashes as None."""
  return [None if t == "–" else float(t.replace(",", "").removesuffix(" %")) for t in texts]


def in_order(values, down):
  """Whether numbers are sorted, with every None at the end."""
  known = [v for v in values if v is not None]
  return values == sorted(known, reverse=down) + [None] * (len(values) - len(known))


def test_opens_and_ranks_by_the_standard_score(browser, file, board):
  browser.open(file)
  expected = [e["detector"] for e in sorted(board["overall"], key=lambda e: -e["cost_standard"])]
  assert browser.column("overall", "detector") == expected
  ranks = dict(zip(expected, browser.column("overall", "rank")))
  real = [d for d in expected if d in REAL]
  assert [ranks[d] for d in real] == [str(i + 1) for i in range(len(real))]
  for name in page.REFERENCES:  # neither ranked nor coloured
    assert ranks[name] == "–"
  assert len(browser.all("#overall tr.reference")) == len(page.REFERENCES)
  assert browser.header("overall", "cost_standard").get_attribute("aria-sort") == "descending"
  assert (
    browser.one("#count").text == "720 of 720 rows" and len(browser.all("#full tbody tr")) == 100
  )
  browser.one("#more").click()
  assert len(browser.all("#full tbody tr")) == 720 and not browser.one("#more").is_displayed()
  about = browser.one("#about").text
  for text in (
    "mjx-cl leaderboard --seeds 10",
    "cpu two cores, cores 2",
    "jax 0.9.2, mujoco 3.14.0",
    "Thresholds were set on seeds 100 to 109.",
  ):
    assert text in about


def test_profile_ranks_by_its_own_score(browser, file, board):
  browser.open(file)
  browser.choose("profile", "few_misses")
  expected = [e["detector"] for e in sorted(board["overall"], key=lambda e: -e["cost_few_misses"])]
  assert (
    browser.column("overall", "detector")
    == expected
    != [e["detector"] for e in sorted(board["overall"], key=lambda e: -e["cost_standard"])]
  )
  assert browser.all("#full th[data-key='cost_few_misses']") and not browser.all(
    "#full th[data-key='cost_standard']"
  )
  assert browser.hash() == "#profile=few_misses"


def test_header_sorts_both_ways_undefined_last(browser, file):
  browser.open(file, "#robot=walker")
  browser.one("#more").click()
  for key, first_down in (("latency_median_s", False), ("cost_standard", True), ("auroc", True)):
    for down in (first_down, not first_down):
      browser.sort("full", key)
      values = numbers(browser.column("full", key))
      assert len(values) == 240 and in_order(values, down), (key, down)
      assert (None in values) == (key in ("latency_median_s", "auroc"))
      header = browser.header("full", key)
      assert (
        header.get_attribute("aria-sort") == ("descending" if down else "ascending")
        and ("▼" if down else "▲") in header.text
      )
  browser.sort("full", "detector")
  names = browser.column("full", "detector")
  assert (
    names == sorted(names)
    and len(browser.all("#full th[aria-sort='ascending'], #full th[aria-sort='descending']")) == 1
  )


def test_header_sorts_by_keyboard_and_keeps_the_focus(browser, file):
  from selenium.webdriver.common.keys import Keys

  browser.open(file)
  browser.js("document.querySelector(\"#overall [data-key='miss_probability'] button\").focus()")
  for down in (False, True):
    browser.driver.switch_to.active_element.send_keys(Keys.ENTER)
    assert in_order(numbers(browser.column("overall", "miss_probability")), down)
  assert browser.js("return document.activeElement.dataset.focus") == "top:miss_probability"


def test_filters_and_search(browser, file, board):
  def count(**want):
    return sum(all(r[k] == v for k, v in want.items()) for r in board["rows"])

  browser.open(file)
  browser.choose("robot", "car")
  assert browser.one("#count").text == f"{count(robot='car')} of 720 rows" and set(
    browser.column("full", "robot")
  ) == {"car"}
  assert [t.text for t in browser.all("#curves text.title")] == ["car"]
  browser.choose("fault", "gear")
  browser.choose("severity", "0.5")
  assert (
    browser.one("#count").text == f"{count(robot='car', fault='gear', severity=0.5)} of 720 rows"
  )
  assert set(browser.column("full", "fault")) == {"gear"} and set(
    browser.column("full", "severity")
  ) == {"0.5"}
  browser.one("#q").send_keys("ROLLING")
  assert sorted(browser.column("full", "detector")) == ["rolling_sigma", "rolling_sigma_plain"]
  browser.one("#q").clear()
  browser.one("#q").send_keys("long windows")  # in the note
  assert browser.column("full", "detector") == ["kswin"]
  browser.one("#reset").click()
  assert (
    browser.one("#count").text == "720 of 720 rows"
    and browser.hash() in ("", "#")
    and browser.one("#q").get_attribute("value") == ""
  )
  browser.one("#refs").click()
  assert browser.one("#count").text == f"{15 * 36} of 720 rows" and not browser.all("tr.reference")


def test_intervals_few_alarms_and_all_columns(browser, file, board):
  browser.open(file, "#robot=walker&fault=gear&severity=1&q=cusum")
  row = next(
    r
    for r in board["rows"]
    if (r["detector"], r["robot"], r["fault"], r["severity"]) == ("cusum", "walker", "gear", 1.0)
  )
  assert browser.one("#full td[data-key='cost_standard'] .ci").text == "[{:.1f}, {:.1f}]".format(
    *row["cost_standard_ci"]
  )
  assert browser.one("#full td[data-key='latency_median_s'] .ci").text.startswith(
    "≥ "
  )  # no upper end
  assert not browser.all("#full th[data-key='threshold']")
  browser.one("#cols").click()
  assert {t.get_attribute("data-key") for t in browser.all("#full thead th")} == {
    c.key for c in page.COLUMNS if "rows" in c.tables
  }
  marks = {}
  for few in (True, False):
    row = next(r for r in board["rows"] if r["arl0_few"] == few)
    browser.open(
      file,
      f"#robot={row['robot']}&fault={row['fault']}&severity={row['severity']:g}&q={row['detector']}&cols=all&sort=detector",
    )
    assert browser.column("full", "detector")[0] == row["detector"]
    first = browser.all("#full tbody tr")[0]
    from selenium.webdriver.common.by import By

    marks[few] = {
      m.find_element(By.XPATH, "..").get_attribute("data-key")
      for m in first.find_elements(By.CSS_SELECTOR, "sup.mark")
    }
  assert marks == {
    True: {"arl0", "threshold", "false_alarms_per_hour", "episode_alarm_probability"},
    False: set(),
  }
  few = {r["detector"] for r in board["rows"] if r["arl0_few"]}
  browser.open(file)
  marked = browser.js(
    "return [...document.querySelectorAll('#overall tbody .pin sup.mark')].map(n => "
    "n.parentNode.querySelector('.v').textContent)"
  )
  assert (
    set(marked) == few
    and 0 < len(few) < 20
    and "fewer than 50 alarms" in browser.one("#overall-foot").text
  )


def test_an_efficiency_above_one_is_marked(browser, file, board, tmp_path):
  page.write(tmp_path / "x.html", **noted(board))
  browser.open(tmp_path / "x.html", "#q=knn")
  marks = browser.js(
    "return [...document.querySelectorAll(\"#full td[data-key='efficiency'] sup.mark\")].map(n "
    "=> [n.textContent, n.title])"
  )
  assert (
    marks == [["*", "above 1: it was luckier"]]
    and "efficiency above 1" in browser.one("#full-foot").text
  )
  browser.open(file)
  assert (
    not browser.all("#full td[data-key='efficiency'] sup.mark")
    and "efficiency above" not in browser.one("#full-foot").text
  )


def test_curves_and_intervals_are_drawn_and_toggle(browser, file, board):
  from selenium.webdriver.common.action_chains import ActionChains
  from selenium.webdriver.support.ui import WebDriverWait

  browser.open(file)
  assert [t.text for t in browser.all("#curves text.title")] == ["car", "quadruped", "walker"]
  best = max(
    (e for e in board["overall"] if e["detector"] in REAL), key=lambda e: e["cost_standard"]
  )["detector"]
  line = f"#curves g.series[data-name='{best}']"
  assert len(browser.all(line)) == 3 and len(browser.all(f"{line} path.curve")) == 3
  marks = browser.js(
    "return "
    "[...document.querySelector(arguments[0]).querySelectorAll('path.tipped:not(.hit)')].map(n "
    "=> n.getBBox().x)",
    line,
  )
  assert (
    len(marks) == 12
    and np.allclose(np.diff(marks), np.diff(marks)[0], atol=0.3)
    and marks[0] < marks[-1]
  )  # geometric rates: even on a log axis
  key = next(k for k in browser.all("#legend .key") if k.text == best)
  assert key.get_attribute("aria-pressed") == "true"
  browser.js("arguments[0].click()", key)
  assert not browser.all(line) and browser.all(f"#intervals g.series.off[data-name='{best}']")
  shown = browser.hash()
  assert shown.startswith("#show=") and best not in shown
  browser.open(file, shown)
  assert not browser.all(line)
  browser.js(
    "[...document.querySelectorAll('#legend .key')].find(n => n.textContent === "
    "arguments[0]).click()",
    best,
  )
  assert len(browser.all(line)) == 3
  # scores lie on their scale: x is linear in the score, and the whisker spans the interval
  places = browser.js("""return Object.fromEntries([...document.querySelectorAll('#intervals svg:first-child line.whisker')].map(n =>
    [n.parentNode.dataset.name, ['x1', 'x2'].map(k => Number(n.getAttribute(k)))]))""")
  ends = np.array([e["cost_standard_ci"] for e in board["overall"] if e["detector"] in REAL])
  x = np.array([places[e["detector"]] for e in board["overall"] if e["detector"] in REAL])
  slope, start = np.polyfit(ends.ravel(), x.ravel(), 1)
  assert (
    slope > 0 and np.abs(slope * ends + start - x).max() < 1e-3
  )  # six digits are embedded; pixels
  # the shaded band starts at the best rank and is as wide as the critical difference
  band = browser.one("#intervals rect.band")
  ticks = browser.js("""return [...document.querySelectorAll("#intervals svg:last-child text.tick[text-anchor='middle']")].map(n =>
    ['textContent', 'x'].map(k => Number(k === 'x' ? n.getAttribute(k) : n[k])))""")
  per_rank, at_zero = np.polyfit(*zip(*ticks), 1)
  best_rank = min(e["mean_rank"] for e in board["overall"] if e["detector"] in REAL)
  assert float(band.get_attribute("width")) == pytest.approx(2.4 * per_rank, abs=0.1)
  assert float(band.get_attribute("x")) == pytest.approx(best_rank * per_rank + at_zero, abs=0.1)
  row = browser.one(f"#intervals svg:first-child g.series[data-name='{best}'] rect.hit")
  browser.js("arguments[0].scrollIntoView({block: 'center'})", row)
  tip, title = browser.one("#tip"), browser.one("#intervals")

  def hovers(_):
    """The pointer comes to the row anew: a late scroll of the page hides the tip, and a pointer
    that rests where it was is no event.
    """
    ActionChains(browser.driver).move_to_element_with_offset(title, 0, 0).move_to_element(
      row
    ).perform()
    return tip.is_displayed()

  WebDriverWait(browser.driver, 30).until(hovers)
  assert best in tip.text and "95 % interval" in tip.text


def test_fault_page_draws_streams_and_alarms(browser, file, board):
  fault = next(
    f for f in board["faults"] if (f["robot"], f["fault"], f["severity"]) == ("walker", "gear", 0.5)
  )
  browser.open(file)
  browser.js(
    "[...document.querySelectorAll('#pages a')].find(a => a.hash === "
    "'#fault/walker/gear/0.5').click()"
  )
  assert (
    browser.one("#page > h2").text == "walker: gear, severity 0.5"
    and not browser.one("#board").is_displayed()
  )
  drawn = browser.js("""return [...document.querySelectorAll('#streams svg')].map(s =>
    [s.dataset.channel, s.querySelector('.trace').getAttribute('d')])""")
  assert [name for name, _ in drawn] == list(fault["channels"])
  for name, path in drawn:
    values = fault["channels"][name]
    points = np.array([[float(v) for v in p.split()] for p in re.split("[ML]", path)[1:]])
    assert len(points) == np.isfinite(values).sum() and path.count("M") == (
      2 if np.isnan(values).any() else 1
    )  # a gap stays a gap
    known = values[np.isfinite(values)]
    assert np.corrcoef(points[:, 1], -known)[0, 1] > 0.9999  # up is more; pixels of one decimal
  # marks stand where the alarms are, on the axis that the onset line fixes
  onset = float(browser.one("#alarms line.onset").get_attribute("x1"))
  lanes = browser.js("""return [...document.querySelectorAll('#alarms g.lane')].map(g => [g.dataset.name, g.querySelector('.alarm') ?
    (b => b.x + b.width / 2)(g.querySelector('.alarm').getBBox()) : null, g.textContent])""")
  assert {n for n, _, _ in lanes} == set(fault["alarms"])
  known = [(fault["alarms"][n], x) for n, x, _ in lanes if x is not None]
  assert (
    len(known)
    == sum(v is not None for v in fault["alarms"].values())
    == len(browser.all("#alarms .alarm"))
  )
  slope = np.polyfit(*zip(*known), 1)[0]
  assert (
    slope > 0 and max(abs(onset + slope * (step - 1200) - x) for step, x in known) < 0.5
  )  # pixels
  assert all(("no alarm" in text) == (n not in fault["early"]) for n, x, text in lanes if x is None)
  steps = [fault["alarms"][n] for n, _, _ in lanes]
  groups = [
    0 if s is not None else 1 if n in fault["early"] else 2 for s, (n, _, _) in zip(steps, lanes)
  ]  # alarms, false alarms, none; the earliest first
  assert (
    groups == sorted(groups)
    and steps[: groups.count(0)] == sorted(steps[: groups.count(0)])
    and set(groups) == {0, 1, 2}
  )
  early = browser.js("""return [...document.querySelectorAll('#alarms .early')].map(n => [n.parentNode.dataset.name, (b => b.x + b.width / 2)(n.getBBox()),
    n.getAttribute('aria-label')])""")
  assert {n for n, _, _ in early} == {"always", "periodic"} and all(
    "before the onset, false" in text for _, _, text in early
  )
  assert max(abs(onset + slope * (fault["early"][n] - 1200) - x) for n, x, _ in early) < 0.5
  assert "after the onset" in browser.one(
    "#alarms g.lane[data-name='always'] .alarm"
  ).get_attribute("aria-label")
  assert len(browser.all("#own tbody tr")) == 20
  browser.js("[...document.querySelectorAll('#page .bar button')][1].click()")
  assert browser.hash() == "#fault/walker/gear/0.5?span=near"
  browser.js("document.querySelector('#page .back').click()")
  assert browser.one("#board").is_displayed() and browser.column("overall", "detector")


def test_fault_page_draws_the_stream_of_any_seed(browser, file, board):
  fault = board["faults"][0]
  first, second = fault["others"]
  address = f"#fault/{fault['robot']}/{fault['fault']}/{fault['severity']}"
  browser.open(file, address)
  drawn = lambda: {
    s.get_attribute("data-channel"): s.find_element("css selector", ".trace").get_attribute("d")
    for s in browser.all("#streams svg")
  }
  foot = lambda: browser.one("#alarms + .foot").text
  before = drawn()
  assert foot().startswith("Seed 0, target left_hip.") and "other seeds" in foot()
  assert [b.text for b in browser.all("#seeds button")] == ["0", "1", "2"] and len(
    browser.all("#alarms .other")
  ) == 6  # three detectors alarm in each of the two others
  browser.js("document.querySelectorAll('#seeds button')[2].click()")
  assert foot().startswith("Seed 2, target right_knee.") and browser.hash() == address + "?seed=2"
  after = drawn()
  assert after.keys() == before.keys() and all(after[c] != before[c] for c in before)
  assert after["reward"].count("L") + 1 == len(second["channels"]["reward"])
  lanes = {g.get_attribute("data-name"): g.text for g in browser.all("#alarms g.lane")}
  shown = [name for name, text in lanes.items() if "no alarm" not in text]
  assert set(shown) == set(second["alarms"]) and len(lanes) == len(second["alarms"])
  browser.open(file, address + "?seed=77")  # not there: the first
  assert foot().startswith("Seed 0")
  (other,) = [f for f in board["faults"][1:2]]
  browser.open(file, f"#fault/{other['robot']}/{other['fault']}/{other['severity']}")
  assert not browser.all("#seeds") and foot().startswith("One seed.")


def test_unknown_fault_says_so(browser, file):
  for name in ("#fault/walker/none/0.5", "#fault/%E0%A4%A/x/1", "#fault/"):
    browser.open(file, name)
    assert browser.one("#page > h2").text == "No such fault"
  browser.open(file, "#fault/walker/gear/1.0")  # another way to write 1
  assert browser.one("#page > h2").text == "walker: gear, severity 1"


def test_link_restores_filter_sort_and_profile(browser, file):
  browser.open(file)
  browser.choose("robot", "walker")
  browser.choose("profile", "few_false")
  browser.one("#q").send_keys("rolling sig&ma=#")
  browser.one("#q").clear()
  browser.one("#q").send_keys("sigma")
  browser.sort("full", "miss_probability")
  browser.sort("full", "miss_probability")
  browser.sort("overall", "detector")  # an order unlike that of the scores
  before = [
    browser.column(t, k)
    for t, k in (
      ("full", "detector"),
      ("full", "fault"),
      ("full", "cost_few_false"),
      ("overall", "detector"),
    )
  ]
  link = browser.hash()
  browser.open(file)
  assert browser.column("full", "detector") != before[0]
  browser.open(file, link)
  assert [
    browser.column(t, k)
    for t, k in (
      ("full", "detector"),
      ("full", "fault"),
      ("full", "cost_few_false"),
      ("overall", "detector"),
    )
  ] == before
  assert set(browser.column("full", "robot")) == {"walker"} and in_order(
    numbers(browser.column("full", "miss_probability")), True
  )
  assert [browser.one(f"#{k}").get_attribute("value") for k in ("robot", "profile", "q")] == [
    "walker",
    "few_false",
    "sigma",
  ]
  browser.open(
    file, "#robot=nobody&profile=none&sort=constructor&top=x"
  )  # what names nothing is left out
  assert browser.one("#count").text == "720 of 720 rows"


def test_hostile_names_stay_text(browser, tmp_path):
  names = (HOSTILE, "__proto__", "a/b?c#d&e=%41", "\"'><img src=x onerror=alert(1)>")
  board = synthetic(
    detectors=names,
    robots={HOSTILE: 0.02, "a/b?c#d%": 0.02},
    faults=(HOSTILE, "x&y=1"),
    severities=(1.0,),
  )
  board["rows"][0]["note"] = HOSTILE
  board["meta"] |= {"notes": [HOSTILE], HOSTILE: {HOSTILE: HOSTILE}}
  board["faults"][0]["channels"] = {HOSTILE: [1.0, 2.0], "__proto__": [2.0, 1.0]}
  page.write(tmp_path / "x.html", **board)
  browser.open(tmp_path / "x.html", "#cols=all")
  assert set(browser.column("overall", "detector")) == set(names)
  assert set(browser.column("full", "robot")) == {
    HOSTILE,
    "a/b?c#d%",
  } and HOSTILE in browser.column("full", "note")
  assert HOSTILE in browser.one("#about").text and not browser.all("b, img")
  browser.choose("robot", "a/b?c#d%")
  rows = browser.column("full", "detector")
  browser.open(tmp_path / "x.html", browser.hash())
  assert browser.column("full", "detector") == rows and len(rows) == 8
  for link in [a.get_attribute("href").partition("#")[2] for a in browser.all("#pages a")]:
    browser.open(tmp_path / "x.html", f"#{link}")
    assert browser.one("#page > h2").text != "No such fault" and not browser.all("b, img")
  browser.open(
    tmp_path / "x.html",
    f"#fault/{urllib.parse.quote(HOSTILE, safe='')}/{urllib.parse.quote(HOSTILE, safe='')}/1",
  )
  assert {s.get_attribute("data-channel") for s in browser.all("#streams svg")} == {
    HOSTILE,
    "__proto__",
  }


def test_empty_leaderboard_opens(browser, tmp_path):
  page.write(tmp_path / "x.html", [], [], {}, [], {})
  browser.open(tmp_path / "x.html")
  assert browser.one("#count").text == "0 of 0 rows" and len(browser.all("#board .empty")) == 2


def test_phone_needs_no_sideways_scroll(browser, file):
  try:
    browser.driver.execute_cdp_cmd(
      "Emulation.setDeviceMetricsOverride",
      {"width": 375, "height": 800, "deviceScaleFactor": 1, "mobile": True},
    )
    for name in ("", "#fault/walker/gear/0.5"):
      browser.open(file, name)
      assert browser.js("return [window.innerWidth, document.documentElement.scrollWidth]") == [
        375,
        375,
      ]
  finally:
    browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_the_published_page_opens_sorts_and_filters(browser):
  import pathlib

  published = pathlib.Path(__file__).parents[2] / "results/leaderboard.html"
  browser.open(published)
  scores = numbers(browser.column("overall", "cost_standard"))
  assert len(scores) > 30 and in_order(scores, True)
  browser.sort("overall", "miss_probability")
  assert in_order(numbers(browser.column("overall", "miss_probability")), False)
  browser.choose("robot", "walker")
  assert set(browser.column("full", "robot")) == {"walker"} and browser.all("#curves path")
  browser.open(
    published,
    browser.js("return document.querySelector(\"a[href^='#fault']\").getAttribute('href')"),
  )
  assert (
    "walker: bias, severity 0.25" in [h.text for h in browser.all("h2")]
    and len(browser.all("svg text")) > 40
  )
