"""The files of `mjx-cl certify`: certificates.parquet, a table for a reader, what `--json` says."""

import pathlib

import pyarrow
import pyarrow.parquet

from mjx_cl import envs
from mjx_cl.errors import FileError, require
from mjx_cl.faults import presets
from mjx_cl.faults.certificate import Certificate, faulty
from mjx_cl.io import folders, tables

# what was measured beside the certificate
COSTS = (
  "physics",
  "agent",
  "episodes",
  "return_nominal",
  "return_mean",
  "return_lost",
  "return_lost_low",
  "return_lost_high",
  "kl_nats",
)
COLUMNS = Certificate._fields + COSTS


def old_rows(folder: pathlib.Path | str) -> list[dict]:
  """Rows of certificates.parquet in `folder`, [] where there is none; FileError for one that is no
  such table or a folder that cannot be written.
  """
  folder = pathlib.Path(folder)
  path = folder / "certificates.parquet"
  try:
    folder.mkdir(parents=True, exist_ok=True)
    probe = folder / "certificates.tmp"
    probe.touch()
    probe.unlink()
    rows = pyarrow.parquet.read_table(path).to_pylist() if path.exists() else []
  except OSError as e:
    raise FileError(f"cannot write in {folder}: {e.strerror or e}") from None
  except pyarrow.ArrowException as e:
    raise FileError(
      f"{path} is no table of certificates: {str(e).splitlines()[0]}; give another --out"
    ) from None
  if rows and set(rows[0]) != set(COLUMNS):
    raise FileError(
      f"{path} has the columns of another version; give another --out, or move it away"
    )
  return rows


def guard(folder: pathlib.Path | str, names: tuple[str, ...], episodes: int) -> None:
  """Refuses what would lose measured costs, before anything is measured."""
  asked = {envs.make(name).spec.name if ":" in name else name for name in names}
  costly = asked & {r["robot"] for r in old_rows(folder) if r["episodes"]}
  require(
    episodes or not costly,
    f"{folder} holds measured costs of {', '.join(sorted(costly))}; give --episodes above 0, "
    "or another --out",
  )


def write(folder: pathlib.Path | str, rows: list[dict]) -> None:
  """Writes certificates.parquet and certificates.md; rows of other robots, faults and backends that
  are there already are kept.
  """
  folder = pathlib.Path(folder)
  which = lambda r: (r["robot"], r["fault"], r["physics"])
  new = {which(r) for r in rows}
  rows = [r for r in old_rows(folder) if which(r) not in new] + rows
  with folders.together():
    tables.write_table(folder / "certificates.parquet", {k: [r[k] for r in rows] for k in COLUMNS})
    folders.atomic(folder / "certificates.md", lambda file: file.write(table(rows).encode()))


ABOUT = """# Certificates: every fault acts

Made by `mjx-cl certify`; all severities are in certificates.parquet. Each line is a \
fault at severity 1 (a preset: its own). `first` is the first control
step from the onset whose outcome differs under the same commands, `after 1, 10, 100` the \
difference so many steps on (root mean square over the
channels, in typical deviations). `return lost`: mean over episodes of the shipped agent, \
which does not adapt, with its 95 % bootstrap interval over
episodes. `KL`: normal fits to ln OPR, ln RPR against the nominal robot's, nats per step.
"""
HEAD = """| family | fault | target | severity | first | after 1 | 10 | 100 | return lost | KL |
|---|---|---|---|---|---|---|---|---|---|"""


def table(rows: list[dict]) -> str:
  """The certificates for a reader: one line per robot, fault and target, its greatest severity;
  backends apart.
  """
  out = [ABOUT]
  for robot, physics in dict.fromkeys((r["robot"], r["physics"]) for r in rows):
    mine = [
      r
      for r in rows
      if (r["robot"], r["physics"]) == (robot, physics)
      and r["fault"] != "none"
      and r["severity"] > 0
    ]
    top: dict[tuple[str, str], dict] = {}
    for r in mine:
      if r["severity"] > top.setdefault((r["fault"], r["target"]), r)["severity"]:
        top[r["fault"], r["target"]] = r
    several = len({r["physics"] for r in rows if r["robot"] == robot}) > 1
    by: dict[tuple, list[str]] = {}
    for r in mine:
      if r["episodes"]:
        by.setdefault((r["return_nominal"], r["episodes"], r["agent"]), []).append(r["fault"])
    said = " ".join(
      f"Nominal return {value:.0f} over {episodes} episodes of agent `{agent}`"
      + (f" ({', '.join(dict.fromkeys(own))})." if len(by) > 1 else ".")
      for (value, episodes, agent), own in by.items()
    )
    said = said or "No agent is shipped for it, so no return is given."
    title = f"## {robot}" + (f", physics {physics}" if several else "")
    out += [title, "", said, "", HEAD, *map(_line, top.values()), ""]
  return "\n".join(out)


def _line(r: dict) -> str:
  """A certificate's line of the table."""
  number = lambda name, form: "" if r[name] is None else format(r[name], form)
  lost = ""
  if r["return_lost"] is not None:
    ends = (number(name, ".0f") for name in ("return_lost_low", "return_lost_high"))
    lost = f"{r['return_lost']:.0f} [{', '.join(ends)}]"
  cells = (
    *(r["family"], r["fault"], r["target"], f"{r['severity']:.3g}", number("first_step", "d")),
    *(number(name, ".2g") for name in ("diff_1", "diff_10", "diff_100")),
    *(lost, number("kl_nats", ".2g")),
  )
  return f"| {' | '.join(cells)} |"


def certificates(rows: list[dict]) -> list[Certificate]:
  """The rows' own part."""
  return [Certificate(*(r[k] for k in Certificate._fields)) for r in rows]


def summary(rows: list[dict]) -> list[dict]:
  """What `--json` prints: {name, value, unit, goal, holds} per robot."""
  out = []
  for robot in dict.fromkeys(r["robot"] for r in rows):
    mine = certificates([r for r in rows if r["robot"] == robot])
    wrong = faulty(mine)
    names = {c.fault for c in mine if c.fault != "none" and not presets.named(c.fault)}
    said = ("faults certified", len(names), "faults", None, None)
    fail = ("faults that fail", len(wrong), "lanes", "== 0", not wrong)
    for name, *values in (said, fail):
      out.append(
        dict(zip(("name", "value", "unit", "goal", "holds"), (f"{robot}: {name}", *values)))
      )
  return out
