"""The board of methods as one HTML file that needs neither network nor JavaScript: the table, and a
section for each setting in which every life is a dot.
"""

from __future__ import annotations

import html
import pathlib

import numpy as np

from mjx_cl.io import folders
from mjx_cl.leaderboard.page import ASSETS
from mjx_cl.scoring import adaptation

WIDTH, LEFT, ROW, TOP = 900, 190, 26, 8  # of a plot [px]
COLOURS = 7  # of leaderboard.css
LEAD = (
  "A robot breaks; a method decides what it does about it. Score 0: as much return is lost as by "
  "doing nothing; 100: none is; below 0 the method does harm. Means over the settings of a robot, "
  "then over robots, with 95 % intervals: a bootstrap of agents and of their seeds."
)
MORE = (
  "section.setting svg { max-width: 100%; height: auto; }\n"
  "section.setting circle { opacity: 0.55; }\n"
  ".mean { stroke: var(--ink); stroke-width: 2.4; }\n"
)
OF = {"harm": "settings", "harm_agents": "pairs", "recovered": "affected"}  # count -> of how many
# key, header, digits, whether in per cent, tooltip
COLUMNS = (
  (
    "streams",
    "Lives",
    0,
    False,
    "Agents x settings x seeds; not every method was lived by all agents",
  ),
  ("score", "Score", 0, False, "0: does nothing; 100: nothing is lost"),
  (
    "gain",
    "Gain over the paper's",
    0,
    False,
    "Score less that of arm `detector`, on the lives of both",
  ),
  (
    "harm",
    "Harm",
    0,
    False,
    "Settings in which more is lost than by doing nothing, by paired intervals",
  ),
  (
    "harm_agents",
    "Harm by agent",
    0,
    False,
    "Pairs of a setting and an agent of which the same holds, by the interval of its seeds",
  ),
  ("harm_streams", "Worse", 0, True, "Lives that lose more than doing nothing by a tenth"),
  ("recovered", "Recovered", 0, False, "Of the lives that lose a tenth without adaptation"),
  ("falls", "Falls", 1, False, "A life, beyond those of doing nothing"),
  ("false_alarms", "False alarms", 0, True, "Lives with an alarm before the fault"),
  (
    "healthy_lost",
    "Lost while healthy",
    1,
    True,
    "Reward before the fault, beyond that of doing nothing: what false alarms cost",
  ),
  ("updates", "Updates", 0, False, "A life"),
  ("wall_s", "Time [s]", 0, False, "A life, of a core"),
  ("mean_rank", "Mean rank", 1, False, "Over settings; 1 is best"),
)


def write(path: pathlib.Path | str, board: adaptation.Board, lives: list[dict], meta: dict) -> None:
  """Writes the page to a temporary name and renames it.

  Args:
    path: of the file.
    board: of the lives.
    lives: see `adaptation.board`.
    meta: printed at the foot.
  """
  methods = [r["method"] for r in board.overall]
  settings = dict.fromkeys((r["robot"], r["setting"]) for r in board.rows)
  body = [
    "<section><h2>Methods</h2>",
    f'<p class="sub">{said(lives)}</p>',
    f'<div class="scroll" tabindex="0" role="region" aria-label="methods">{overall(board)}</div>',
    "</section>",
    "<nav>" + " ".join(f'<a href="#{link(*of)}">{text(" ".join(of))}</a>' for of in settings),
    "</nav>",
    *(section(of, board, lives, methods) for of in settings),
  ]
  foot = "".join(f"<dt>{text(k)}</dt><dd>{text(v)}</dd>" for k, v in meta.items())
  css = (ASSETS / "leaderboard.css").read_text(encoding="utf-8") + MORE
  page = f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<title>mjx_cl: methods of adaptation</title>
<style>
{css}</style>
</head>
<body>
<header><h1>mjx_cl: methods of adaptation</h1>
<p class="lead">{text(LEAD)}</p></header>
<main>
{"".join(body)}
</main>
<footer><dl>{foot}</dl></footer>
</body>
</html>
"""
  folders.atomic(path, lambda file: file.write(page.encode()))


def text(value: object) -> str:
  """As HTML shows it."""
  return html.escape(str(value))


def link(robot: str, setting: str) -> str:
  """Name of a setting's section."""
  return html.escape("".join(c if c.isalnum() else "-" for c in f"{robot}-{setting}"))


def said(lives: list[dict]) -> str:
  """What the board rests on."""
  count = lambda key: len({life[key] for life in lives})
  agents = len({(life["robot"], life["agent"]) for life in lives})
  return (
    f"{len(lives):,} lives: {count('setting')} settings, {count('robot')} robots, {agents} agents, "
    f"seeds {min(life['seed'] for life in lives)} to {max(life['seed'] for life in lives)}."
  )


def number(x: float | None, digits: int, share: bool = False) -> str:
  """A figure of a table."""
  if x is None:
    return "-"
  return f"{100 * x:.{digits}f} %" if share else f"{x:,.{digits}f}"


def cell(row: dict, key: str, digits: int, share: bool) -> str:
  """A cell of a table, with its interval where there is one."""
  value = number(row[key], digits, share)
  if key in OF:
    value = f"{row[key]} of {row[OF[key]]}"
  ends = row.get(f"{key}_ci")
  between = ""
  if ends is not None:
    low, high = (number(x, digits, share) for x in ends)
    between = f'<span class="ci">{low} to {high}</span>'
  return f'<td><span class="v">{value}</span>{between}</td>'


def overall(board: adaptation.Board) -> str:
  """The table of methods."""
  robots = list(dict.fromkeys(r["robot"] for r in board.rows))
  columns = list(COLUMNS)
  columns[2:2] = [
    (f"score_{robot}", robot, 0, False, f"Score on the settings of {robot}") for robot in robots
  ]
  head = "".join(f'<th title="{text(c[4])}">{text(c[1])}</th>' for c in columns)
  lines = []
  for row in board.overall:
    reference = row["method"] == adaptation.NOTHING
    cells = "".join(
      cell({f"score_{r}": None for r in robots} | row, c[0], c[2], c[3]) for c in columns
    )
    name = f'<th class="text pin" scope="row">{text(row["method"])}</th>'
    lines.append(f'<tr class="{"reference" if reference else ""}">{name}{cells}</tr>')
  return (
    f'<table><thead><tr><th class="text pin">Method</th>{head}</tr></thead>'
    f"<tbody>{''.join(lines)}</tbody></table>"
  )


def section(
  of: tuple[str, str], board: adaptation.Board, lives: list[dict], methods: list[str]
) -> str:
  """One setting: what it is, and a line of dots for each method."""
  own = [x for x in lives if (x["robot"], x["setting"]) == of]
  rows = {r["method"]: r for r in board.rows if (r["robot"], r["setting"]) == of}
  one = own[0]
  severities = dict.fromkeys(x["severity"] for x in own if x["severity"] is not None)
  what = one["fault"] + (", severity " if severities else "")
  what += " or ".join(f"{s:g}" for s in severities)
  what += f", target {one['target']}" if one.get("target") else ""
  what += f"; from step {one['onset']:,} on, {one['steps']:,} steps"
  return (
    f'<section class="setting" id="{link(*of)}"><h2>{text(" ".join(of))}</h2>'
    f'<p class="sub">{text(what)}. Share of the return lost after the fault, a dot for each life, '
    f"a bar for the mean.</p>{plot(own, of, rows, [m for m in methods if m in rows])}</section>"
  )


def plot(lives: list[dict], of: tuple[str, str], rows: dict[str, dict], methods: list[str]) -> str:
  """Shares of return lost, a line for each method."""
  pairs = adaptation.paired(lives)[of]
  lost = {m: [pair.lost for pair in pairs[m].values()] for m in methods}
  every = [x for own in lost.values() for x in own if np.isfinite(x)] or [0.0]
  low, high = min(0.0, *every), max(0.1, *every)
  step = next(s for s in (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 1e9) if (high - low) / s <= 9)
  low, high = step * np.floor(low / step), step * np.ceil(high / step)
  at = lambda x: LEFT + (WIDTH - LEFT - 90) * (x - low) / (high - low)
  bottom = TOP + ROW * len(methods)
  out = [f'<svg viewBox="0 0 {WIDTH} {bottom + 26}" width="{WIDTH}" role="img" aria-label="lives">']
  for tick in np.arange(low, high + step / 2, step):
    x = at(tick)
    out.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{bottom}"/>')
    out.append(
      f'<text class="tick" x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{tick:.0%}</text>'
    )
  for i, name in enumerate(methods):
    y = TOP + ROW * (i + 0.5)
    out.append(f'<text x="{LEFT - 10}" y="{y + 4:.1f}" text-anchor="end">{text(name)}</text>')
    for x in lost[name]:
      if np.isfinite(x):
        out.append(
          f'<circle cx="{at(x):.1f}" cy="{y:.1f}" r="4" fill="var(--c{i % COLOURS})">'
          f"<title>{x:.1%}</title></circle>"
        )
    mean = rows[name]["lost"]
    if mean is not None:
      x = at(mean)
      out.append(
        f'<line class="mean" x1="{x:.1f}" x2="{x:.1f}" y1="{y - 10:.1f}" y2="{y + 10:.1f}"/>'
      )
    score = number(rows[name]["score"], 0)
    out.append(
      f'<text class="tick" x="{WIDTH - 6}" y="{y + 4:.1f}" text-anchor="end">{score}</text>'
    )
  return "".join([*out, "</svg>"])
