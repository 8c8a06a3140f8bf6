"""Hook of mkdocs.yml: README, results and the pages of detectors, faults and robots join docs/, and
links between files of the repository become links of the site.
"""

from __future__ import annotations

import ast
import os
import pathlib
import posixpath
import re
from typing import Any

import pyarrow.parquet as parquet
from mkdocs.structure.files import File, Files
from pymdownx import slugs

ROOT = pathlib.Path(__file__).parents[1]
SHOWN = {".png", ".gif", ".html"}  # what a page may link to beside pages
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)#\s]+)?(#[^)\s]+)?\)")
ROBOTS = ("walker", "quadruped", "car", "car_real")
FAULTS = {
  "Motors": "actuator",
  "Sensors": "sensor",
  "Body": "body",
  "Ground": "contact",
  "Task": "task",
  "Presets": "presets",
}
API = {"Library": "library", "Configuration": "config", "Types": "types"}


def sources() -> dict[str, str]:
  """Page of the site -> file of the repository, of pages that do not lie in docs/."""
  pages = {"index.md": "README.md"}
  for name in ("CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md", "results/README.md"):
    pages[name] = name
  for path in sorted((ROOT / "results").glob("*/README.md")):
    name = path.relative_to(ROOT).as_posix()
    pages[name] = name
  return pages


def detectors() -> dict[str, tuple[str, str]]:
  """Name of a detector -> its module and function, as detectors/table.py has them."""
  tree = ast.parse((ROOT / "mjx_cl/detectors/table.py").read_text())
  modules = {
    alias.name: node.module
    for node in ast.walk(tree)
    if isinstance(node, ast.ImportFrom) and node.module
    for alias in node.names
  }
  (table,) = (node for node in ast.walk(tree) if isinstance(node, ast.Dict))
  return {
    key.value: (modules[value.id], value.id)
    for key, value in zip(table.keys, table.values)
    if isinstance(key, ast.Constant) and isinstance(value, ast.Name)
  }


def row(name: str) -> str:
  """A detector on the shipped leaderboard."""
  board = parquet.read_table(ROOT / "results/leaderboard_overall.parquet").to_pylist()
  lines = []
  for one in board:
    if re.split(r"[ @]", one["detector"])[0] == name:
      score = [one[f"cost_standard{end}"] for end in ("", "_low", "_high")]
      lines.append(
        f"| `{one['detector']}` | {score[0]:.1f} [{score[1]:.1f}, {score[2]:.1f}] "
        f"| {one['detected_within_5s']:.0%} | {one['miss_probability']:.0%} "
        f"| {one['false_alarms_per_hour']:.1f} |"
      )
  head = (
    "| entry | score of 100 | within 5 s | missed | false alarms an hour |\n|---|---|---|---|---|\n"
  )
  about = (
    "On the [leaderboard](../leaderboard.md), all settings of three robots, one agent each:\n\n"
  )
  return about + head + "\n".join(lines) + "\n\n" if lines else ""


def reference() -> dict[str, dict[str, str]]:
  """Section -> page -> Markdown, from docstrings."""
  pages: dict[str, dict[str, str]] = {"Detectors": {}, "Faults": {}, "Robots": {}, "API": {}}
  for name, (module, function) in sorted(detectors().items()):
    pages["Detectors"][name] = f"# {name}\n\n{row(name)}::: {module}.{function}\n"
  for title, module in FAULTS.items():
    about = "What each does, and to which robots: [faults](../faults.md).\n\n"
    pages["Faults"][title] = f"# {title}\n\n{about}::: mjx_cl.faults.{module}\n"
  for name in ROBOTS:
    pages["Robots"][name] = f"# {name}\n\n::: mjx_cl.envs.{name}\n"
  for title, module in API.items():
    pages["API"][title] = f"# {title}\n\n::: mjx_cl.{module}\n"
  return pages


def uri(section: str, title: str) -> str:
  """Of a page of the reference."""
  return f"{section.lower()}/{title.lower()}.md"


def on_config(config: Any) -> Any:
  """Headings get the anchors that GitHub gives them; the reference joins the navigation."""
  config.mdx_configs["toc"]["slugify"] = slugs.slugify(case="lower")
  config.nav.insert(
    -1, {"Reference": [{s: [{t: uri(s, t)} for t in own]} for s, own in reference().items()]}
  )
  shown = {page for _, page in _leaves(config.nav)}
  own = {p.split("/")[1]: p for p in sources() if p.startswith("results/") and p not in shown}
  results = next(
    own_nav for part in config.nav for title, own_nav in part.items() if title == "Results"
  )
  results.append({"Experiments": [{name: page} for name, page in own.items()]})
  return config


def _leaves(nav: list) -> list[tuple[str, str]]:
  found = []
  for part in nav:
    for title, value in part.items():
      found += [(title, value)] if isinstance(value, str) else _leaves(value)
  return found


def on_files(files: Files, config: Any) -> Files:
  """Pages from outside of docs/, and the pictures that pages show."""
  texts = {page: (ROOT / path).read_text() for page, path in sources().items()}
  for page, text in texts.items():
    files.append(File.generated(config, page, content=text))
  for section, own in reference().items():
    for title, text in own.items():
      files.append(File.generated(config, uri(section, title), content=text))
  texts |= {
    path.relative_to(ROOT / "docs").as_posix(): path.read_text()
    for path in (ROOT / "docs").rglob("*.md")
  }
  for page, text in texts.items():
    for _, _, at, _ in LINK.findall(text):
      path = target(page, at)
      if path and path.suffix in SHOWN and not path.is_relative_to(ROOT / "docs"):
        name = path.relative_to(ROOT).as_posix()
        if files.get_file_from_path(name) is None:
          files.append(File.generated(config, name, abs_src_path=os.fspath(path)))
  return files


def target(page: str, at: str) -> pathlib.Path | None:
  """The file that a link of a page names; None: it leads out of the repository."""
  if not at or re.match(r"[a-z]+:", at):
    return None
  here = ROOT / sources().get(page, f"docs/{page}")
  return pathlib.Path(os.path.normpath(here.parent / at))


def place(path: pathlib.Path) -> str | None:
  """A file's address on the site; None where it is not on it."""
  name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else ""
  if path.is_dir():
    name += "/README.md"
  back = {file: page for page, file in sources().items()}
  if name in back:
    return back[name]
  if name.startswith("docs/"):
    return name.removeprefix("docs/")
  return name if path.suffix in SHOWN else None


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
  """Links to files of the site; of what is not on it the words alone."""
  here = page.file.src_uri

  def linked(match: re.Match) -> str:
    mark, text, at, anchor = match.groups()
    path = target(here, at)
    if path is None or here not in sources() and here.split("/")[0] in REFERENCE:
      return match[0]
    to = place(path)
    if to is None:
      return text
    return f"{mark}[{text}]({posixpath.relpath(to, posixpath.dirname(here) or '.')}{anchor or ''})"

  return indented(LINK.sub(linked, markdown))


REFERENCE = {section.lower() for section in ("Detectors", "Faults", "Robots", "API")}


def indented(markdown: str) -> str:
  """Lists as Python-Markdown takes them: four columns a level, an empty line before the first."""
  lines: list[str] = []
  fence = ""
  for line in markdown.split("\n"):
    space = line[: len(line) - len(line.lstrip(" "))]
    mark = re.match(r"(```+|~~~+)", line.lstrip())
    if fence:
      lines.append(fence[1:] + line)
      if mark and line.strip() == mark[1] and mark[1].startswith(fence[0] * 3):
        fence = ""
      continue
    if mark:
      fence = mark[1][0] + space
    item, before = re.match(r"\s*(\*|-|\d+\.) ", line), lines[-1] if lines else ""
    if item and not space and before.strip() and not re.match(r"\s+|(\*|-|\d+\.) ", before):
      lines.append("")
    lines.append(space + line)
  return "\n".join(lines)
