"""Digests of small fixed runs of every command, to tell whether a change of code changed a result.

  python benchmarks/reference.py run [--checkout DIR] [--all | --only CASE ...] [--out FILE]
  python benchmarks/reference.py compare BEFORE.json AFTER.json [--only CASE ...]

`run` calls `python -m mjx_cl ...` as reference.toml says, in fresh processes that import the
package of the checkout, any commit of it. It writes one JSON: case, file, then a digest of each
array of an .npz, each column of a Parquet or CSV table and each value of a JSON file or of standard
output (file `COMMAND.stdout`), beside it [mean, deviation, minimum, maximum] of numbers. Of other
files (pictures, pages) it holds the names, of `list` too, and nothing of what EXCLUDED names.
`compare` prints what differs or stands on one side alone, and ends with 1 where there is anything.

Digests hold for one machine, one number of cores and one set of packages: elsewhere XLA rounds
otherwise. Make both files on the same machine, the older one from a checkout of the commit before
(`git worktree add DIR COMMIT`). Compiled programs are shared through MJX_CL_CACHE.
"""

from __future__ import annotations

import argparse
import collections
import csv
import fnmatch
import hashlib
import json
import os
import pathlib
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib

import numpy as np
import pyarrow.parquet

# Names of files, folders, columns or keys of which no digest is made, nor of what is below them.
EXCLUDED = {
  "wall_*": "wall time",
  "seconds": "wall time of a training",
  "collect_s": "wall time of a training's acting",
  "learn_s": "wall time of a training's updates",
  "us_per_sample": "wall time of a detector",
  "stream_steps_per_s": "speed of a recording",
  "bytes": "size of a recording, its config.json with what stands here included",
  "machine": "where it ran",
  "versions": "packages that it ran with",
  "python": "version that it ran with",
  "git_commit": "commit of the checkout",
  "command": "how it was called, with the path of the program",
  "work": "files of a run under way",
  "checkpoints": "files of a training under way, as many as there was time for",
}

CONFIG = tomllib.loads(pathlib.Path(__file__).with_suffix(".toml").read_text())
CASES, CUT, WORDS = CONFIG["cases"], CONFIG["cut"], CONFIG["words"]


def log(steps: int, shift: float) -> str:
  """A CSV log of three columns, the second of which shifts at sample 1,000."""
  rng = np.random.default_rng(steps)
  values = rng.normal(size=(steps, 3)) + 0.01 * rng.normal(size=(steps, 3)).cumsum(0)
  values[1000:, 1] += shift
  rows = (",".join(f"{x:.6f}" for x in (0.02 * t, *row)) for t, row in enumerate(values))
  return "\n".join(["time,a,b,c", *rows]) + "\n"


# ---- digests ----


def excluded(path: tuple[str, ...]) -> bool:
  """Whether a part of a path of folders, files, columns or keys is left out."""
  return any(fnmatch.fnmatchcase(part, pattern) for part in path for pattern in EXCLUDED)


def numbers(values) -> list:
  """The numbers in nested lists, in order."""
  if isinstance(values, list):
    return [x for value in values for x in numbers(value)]
  return [values] if isinstance(values, int | float) else []


def entry(values, kind: str) -> dict:
  """Type, SHA-256, number of values and a summary of an array or a list; nan and null count not.

  An array's digest is of its bytes, with one kind of nan; a list's of its JSON, floats by repr. A
  single value stands there itself.
  """
  if isinstance(values, np.ndarray):
    if values.dtype.kind == "f":
      values = np.where(np.isnan(values), np.asarray(np.nan, values.dtype), values)
    content, number = values.tobytes(), values.size
    known = values.ravel() if values.dtype.kind in "biuf" else []
  else:
    content, number = json.dumps(values, default=float).encode(), len(values)
    known = numbers(values)
  out = {"type": kind, "number": number, "sha256": hashlib.sha256(content).hexdigest()}
  if isinstance(values, list) and len(values) == 1 and not isinstance(values[0], list):
    return out | {"value": values[0]}
  known = np.asarray(known, float)
  known = known[np.isfinite(known)]
  functions = (np.mean, np.std, np.min, np.max) if len(known) else ()
  return out | {"summary": [float(f"{f(known):.6g}") for f in functions]}


def leaves(value, path: tuple[str, ...] = ()):
  """(path, value) of all in a JSON value; dicts in a list are rows of a table, keys its columns."""
  if excluded(path):
    return
  if isinstance(value, dict) and value:
    for key in value:
      yield from leaves(value[key], (*path, key))
  elif isinstance(value, list) and any(isinstance(x, dict) for x in value):
    for row in value:
      yield from leaves(row, (*path, "[]"))
  else:
    yield path, value


def of_json(value) -> dict[str, dict]:
  """Entries of a JSON value by path."""
  found = collections.defaultdict(list)
  for path, leaf in leaves(value):
    found["/".join(path)].append(leaf)
  return {path: entry(values, "json") for path, values in found.items()}


def of_file(path: pathlib.Path) -> dict[str, dict]:
  """Entries of a file by array, column or key."""
  if path.suffix == ".json":
    return of_json(json.loads(path.read_text()))
  if path.suffix == ".npz":
    with np.load(path) as file:
      columns = {n: (file[n], f"{file[n].dtype}{list(file[n].shape)}") for n in file.files}
  elif path.suffix == ".parquet":
    table = pyarrow.parquet.read_table(path)
    columns = {n: (table[n].to_pylist(), str(table[n].type)) for n in table.column_names}
  elif path.suffix == ".csv":
    lines = list(csv.reader(path.read_text().splitlines()))
    columns = {name: (values, "text") for name, *values in zip(*lines, strict=True)}
  else:
    columns = {"exists": ([True], "file")}
  return {name: entry(*column) for name, column in columns.items() if not excluded((name,))}


def of_folder(folder: pathlib.Path) -> dict[str, dict]:
  """Entries of all files in a folder, by their paths in it."""
  paths = {p.relative_to(folder): p for p in sorted(folder.rglob("*")) if p.is_file()}
  return {str(name): of_file(p) for name, p in paths.items() if not excluded(name.parts)}


def differences(before: dict, after: dict) -> list[str]:
  """What differs between two nested dicts whose leaves are entries, a line each."""
  lines = []
  for name in sorted({**before, **after}):
    if name not in before or name not in after:
      lines.append(f"{name}: only in the {'first' if name in before else 'second'}")
    elif "sha256" not in before[name]:
      lines += [f"{name}/{line}" for line in differences(before[name], after[name])]
    elif before[name] != after[name]:
      old, new = ([side[name].get(k) for k in ("type", "number", "value", "summary")]
                  for side in (before, after))  # fmt: skip
      told = [f"{a} -> {b}" for a, b in zip(old, new, strict=True) if a != b]
      lines.append(f"{name}: {', '.join(told) or 'no difference in six digits'}")
  return lines


# ---- commands ----


def command(text: str) -> list[str]:
  """Words of a command of CASES."""
  while "{" in text:
    text = text.format_map(WORDS)
  return shlex.split(text)


class Failed(Exception):
  """A command that did not end as it should."""


def start(words: list[str], folder: pathlib.Path, checkout: pathlib.Path) -> subprocess.Popen:
  """`mjx-cl WORDS` of a checkout under way in a folder, its output in files there."""
  with (folder / "stdout").open("w") as out, (folder / "stderr").open("w") as err:
    return subprocess.Popen([sys.executable, "-m", "mjx_cl", *words], cwd=folder, stdout=out,
                            stderr=err, env=os.environ | {"PYTHONPATH": str(checkout)})  # fmt: skip


def cut_off(process: subprocess.Popen, folder: pathlib.Path, when, text, after_s, **cut) -> None:
  """Sends a process its signal, see `cut` in reference.toml."""
  while process.poll() is None and not any(text in p.read_text() for p in folder.glob(when)):
    time.sleep(0.02)
  time.sleep(after_s)
  process.send_signal(signal.Signals[cut["signal"]])
  if process.wait() not in (130, -signal.SIGKILL):
    raise Failed(f"ended with {process.returncode} before it could be cut off")


def live(name: str, folder: pathlib.Path, checkout: pathlib.Path) -> dict[str, dict]:
  """Runs the commands of a case in a new folder; entries of their files and output."""
  shutil.rmtree(folder, ignore_errors=True)
  folder.mkdir(parents=True)
  logs = {"nominal.csv": log(4000, 0.0), "log.csv": log(2000, 2.0)}
  for file, text in (CONFIG["files"] | logs).items():
    (folder / file).write_text(text)
  printed = {}
  for words in map(command, CASES[name]):
    if name in CUT and not printed:
      cut_off(start(words, folder, checkout), folder, **CUT[name])
      words.append("--resume")
    if words[0] == "plot":
      (folder / words[1] / "figure.png").unlink()
    if code := start(words, folder, checkout).wait():
      last = (folder / "stderr").read_text().strip().splitlines()[-3:]
      raise Failed(f"{' '.join(words[:2])} ended with {code}: {' | '.join(last)}")
    if "--json" in words:
      value = json.loads((folder / "stdout").read_text())
      value = {k: sorted(v) for k, v in value.items()} if words[0] == "list" else value
      printed[f"{words[0]}{len(printed) or ''}.stdout"] = of_json(value)
  return of_folder(folder / "out") | printed


def seen(folder: pathlib.Path) -> collections.Counter:
  """How often each kind of event and each outcome of a stream stands in a folder's results."""
  found = collections.Counter()
  for name, column in (("events", "kind"), ("runs", "outcome")):
    for path in folder.rglob(f"{name}.parquet"):
      found.update(pyarrow.parquet.read_table(path, columns=[column])[column].to_pylist())
  return found


def run(args: argparse.Namespace) -> int:
  """Lives the cases one after another; writes the file anew after each."""
  checkout, work = pathlib.Path(args.checkout).resolve(), pathlib.Path(args.work).resolve()
  if not (checkout / "mjx_cl" / "__main__.py").exists():
    raise SystemExit(f"{checkout} is no checkout of mjx_cl")
  signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's `&` lets children ignore it
  commit = subprocess.getoutput(f"git -C {shlex.quote(str(checkout))} rev-parse HEAD")
  cases, walls, wrong, total = {}, {}, [], collections.Counter()
  usual = [name for name in CASES if args.all or name not in CONFIG["long"]]
  for name in args.only or usual:
    begin = time.monotonic()
    try:
      cases[name] = live(name, work / name, checkout)
    except (Failed, OSError, ValueError) as e:
      cases[name] = {"failed": {"failed": entry([str(e)], "text")}}
      wrong.append(f"{name}: {e}")
    walls[name], found = round(time.monotonic() - begin, 1), seen(work / name / "out")
    total += found
    told = "".join(f", {n} {kind}" for kind, n in sorted(found.items()))
    print(f"{name}: {walls[name]} s, {sum(map(len, cases[name].values()))} digests{told}")
    sys.stdout.flush()
    value = {"commit": commit, "wall_s": walls, "cases": cases}
    pathlib.Path(args.out).write_text(json.dumps(value, indent=1, sort_keys=True) + "\n")
  for name, whole in ((name, cut["like"]) for name, cut in CUT.items()):
    if {name, whole} <= set(cases):
      same = {k: v for k, v in cases[whole].items() if k in cases[name]}
      wrong += [f"not as in {whole}: {name}/{line}" for line in differences(same, cases[name])]
  print(*wrong, f"{sum(walls.values()):.0f} s, {dict(sorted(total.items()))}", sep="\n")
  return int(bool(wrong))


def compare(args: argparse.Namespace) -> int:
  """Prints what differs between two files."""
  before, after = (json.loads(pathlib.Path(p).read_text())["cases"] for p in (args.a, args.b))
  if args.only:
    before, after = ({k: v for k, v in side.items() if k in args.only} for side in (before, after))
  lines = differences(before, after)
  lines += [f"{name}: failed" for name in after if "failed" in after[name]]
  print(*lines, f"{len(lines)} differences in {len({**before, **after})} cases", sep="\n")
  return int(bool(lines))


def main(argv: list[str] | None = None) -> int:
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  commands = parser.add_subparsers(required=True)
  one, two = (commands.add_parser(f.__name__, help=f.__doc__) for f in (run, compare))
  here = pathlib.Path(__file__).resolve().parent.parent
  one.add_argument("--checkout", default=here, help="source tree to check; default: this one")
  one.add_argument("--out", default="reference.json", help="file for the digests")
  one.add_argument("--work", default="runs/reference", help="folder that the commands work in")
  one.add_argument("--all", action="store_true", help="long cases too")
  two.add_argument("a", help="digests of the older checkout")
  two.add_argument("b", help="digests of the newer one")
  for command, do in ((one, run), (two, compare)):
    command.add_argument("--only", nargs="+", choices=CASES, help="these cases alone")
    command.set_defaults(do=do)
  args = parser.parse_args(argv)
  return args.do(args)


if __name__ == "__main__":
  sys.exit(main())
