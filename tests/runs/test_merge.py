"""Runs of other seeds joined to one: a finished run taken apart by seed and joined again is what it
was.
"""

import contextlib
import dataclasses
import json
import pathlib
import shutil
import subprocess
import sys

import numpy as np
import pyarrow.compute
import pyarrow.parquet
import pytest
from test_cli import mjx, refused  # noqa: F401  fixtures

from mjx_cl.config import RunConfig
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import arrays, tables
from mjx_cl.runs import bench, costs, merge, records, summary
from mjx_cl.runs import suite as suites
from mjx_cl.scoring import stop_rule
from mjx_cl.training import agents

RESULTS = pathlib.Path(__file__).parents[2] / "results"
RUNS = {
  "walker": ("paper", "walker"),
  "car": ("paper", "car"),
  "snapshots": ("stop", "damping"),
  "told": ("oracle_stop", "damping"),
}  # car: two changes of each stream; its onsets are its own


def part_of(suite, name, seeds=None):
  known = suite in suites.shipped()
  (part,) = suites.pick(
    (
      suites.suite(suite) if known else bench._published(RESULTS / suite, suite.replace("_", "-"))
    ).parts,
    (name,),
  )
  return part._replace(config=dataclasses.replace(part.config, seeds=seeds or part.config.seeds))


def cut(folder, out, seeds):
  """The streams of `seeds` of a finished run, as a run of those seeds alone would have left them."""
  out.mkdir(parents=True)
  for file in folder.glob("*.parquet"):
    table = pyarrow.parquet.read_table(file)
    table = table.filter(
      pyarrow.compute.is_in(table["seed"], pyarrow.array(seeds, table["seed"].type))
    )
    streams = {
      old: new for new, old in enumerate(sorted(set(table["stream"].to_pylist())))
    }  # arm by arm, seed by seed
    at = table.column_names.index("stream")
    tables.write_arrow(
      out / file.name,
      table.set_column(
        at,
        "stream",
        pyarrow.array([streams[s] for s in table["stream"].to_pylist()], table["stream"].type),
      ),
    )
  config = json.loads((folder / "config.json").read_text())
  if "oracle_stops" in config:
    config["oracle_stops"] = {str(seed): config["oracle_stops"][str(seed)] for seed in seeds}
  tables.write_json(
    out / "config.json",
    config | {"seeds": len(seeds), "first_seed": seeds[0], "git_commit": f"of seed {seeds[0]}"},
  )
  summary = json.loads((folder / "summary.json").read_text())
  share = len(seeds) / config["seeds"]
  summary |= {k: share * summary[k] for k in ("wall_s", "wall_s_snapshots") if k in summary}
  summary |= {
    "wall_s_arms": {k: share * v for k, v in summary["wall_s_arms"].items()},
    "arms": "wrong: to be computed anew",
  }
  tables.write_json(out / "summary.json", summary)
  return out


def close(a, b, at=""):
  """Equal, floats to the rounding of a sum in another order."""
  if isinstance(a, dict):
    assert set(a) == set(b), (at, set(a) ^ set(b))
    for k in a:
      close(a[k], b[k], f"{at}.{k}")
  elif isinstance(a, list):
    assert len(a) == len(b), at
    for i, (x, y) in enumerate(zip(a, b)):
      close(x, y, f"{at}[{i}]")
  else:
    assert a == (pytest.approx(b, rel=1e-9) if isinstance(b, float) else b), at


def bounded(published, today):
  """What was published, with today's bounds: those of shares were made with a normal quantile of
  seven digits.
  """
  if not isinstance(published, dict):
    return published
  return {k: today[k] if k.endswith("_ci") else bounded(v, today[k]) for k, v in published.items()}


@pytest.mark.parametrize("suite, name", RUNS.values(), ids=RUNS)
def test_what_is_taken_apart_and_joined_is_what_it_was(tmp_path, suite, name, monkeypatch):
  monkeypatch.chdir(RESULTS.parent)  # where the folder of oracle stops is named from
  folder = RESULTS / suite / name
  whole = json.loads((folder / "config.json").read_text())
  part = part_of(suite, name, whole["seeds"])
  k = whole["seeds"] // 3
  split = [list(range(k)), list(range(k, k + 1)), list(range(k + 1, whole["seeds"]))]
  folders = [cut(folder, tmp_path / f"p{i}", seeds) for i, seeds in enumerate(split)]
  assert merge.choose(folders[::-1], part.config) == folders  # in the order of their seeds
  value = merge.join(folders, tmp_path / "all", part.config)
  today = shutil.copytree(folder, tmp_path / "today")
  rows = records.set_apart(*(tables.read_rows(today / f"{k}.parquet") for k in ("runs", "events")))
  # what is published may be older than a definition, and has no trace
  wanted = tables.read_json(today / "summary.json") | {"invalid_share_ci": None}
  wanted |= summary.by_arm(rows, part.config, whole["control_s"])
  if "stop_rule" in wanted:
    judged = stop_rule.summarise(tables.read_rows(today / "stop.parquet"))
    wanted["stop_rule"] = bounded(wanted["stop_rule"], judged)
  for file in today.glob("*.parquet"):
    want, got = (
      pyarrow.parquet.read_table(file),
      pyarrow.parquet.read_table(tmp_path / "all" / file.name),
    )
    if file.stem == "runs":
      got, want = (
        pyarrow.Table.from_pylist(
          [r | {"adapting_at_onset": bool(r.get("adapting_at_onset"))} for r in t.to_pylist()]
        )
        for t in (got, want)
      )
    assert got.to_pylist() == want.to_pylist() and got.schema.names == want.schema.names, file.name
  close(value, wanted)
  assert json.loads((tmp_path / "all/summary.json").read_text()) == value
  config = json.loads((tmp_path / "all/config.json").read_text())
  assert [(p["first_seed"], p["seeds"], p["git_commit"]) for p in config.pop("pieces")] == [
    (s[0], len(s), f"of seed {s[0]}") for s in split
  ]
  assert config | {"git_commit": whole["git_commit"]} == whole
  assert suites.finished(tmp_path, suites.Part("all", part.config))
  # pieces of a joined piece are named one by one
  twice = cut(folder, tmp_path / "q", split[2])
  first = merge.join(folders[:2], tmp_path / "first", part_of(suite, name, k + 1).config)
  assert first["arms"] != value["arms"]
  merge.join([tmp_path / "first", twice], tmp_path / "again", part.config)
  assert [
    p["seeds"] for p in json.loads((tmp_path / "again/config.json").read_text())["pieces"]
  ] == [len(s) for s in split]


def test_a_table_that_one_piece_lacks_is_left_out(tmp_path):
  folder = RESULTS / "stop/damping"
  part = part_of("stop", "damping", 5)
  folders = [cut(folder, tmp_path / "a", [0, 1]), cut(folder, tmp_path / "b", [2, 3, 4])]
  (folders[1] / "stop.parquet").unlink()
  value = merge.join(folders, tmp_path / "all", part.config)
  assert "stop_rule" not in value and {p.name for p in (tmp_path / "all").iterdir()} == {
    "config.json",
    "summary.json",
    "runs.parquet",
    "events.parquet",
    "snapshots.parquet",
    "signals.parquet",
  }


def test_a_piece_that_was_told_other_stops_is_refused(tmp_path, monkeypatch):
  monkeypatch.chdir(RESULTS.parent)
  folder, config = (
    cut(RESULTS / "oracle_stop/damping", tmp_path / "a", [3, 4]),
    part_of("oracle_stop", "damping").config,
  )
  assert merge.seeds_of(folder, config) == [3, 4]
  own = json.loads((folder / "config.json").read_text())
  for stops in (
    {"3": 1},
    own["oracle_stops"] | {"3": own["oracle_stops"]["3"] + 1},
  ):  # one is missing, one is another
    tables.write_json(folder / "config.json", own | {"oracle_stops": stops})
    with pytest.raises(UserError, match="another oracle_stops"):
      merge.seeds_of(folder, config)


def test_agents_and_residuals_come_along(tmp_path):
  """Of pieces that are joined, and of a part that one folder holds whole."""
  folder, part = RESULTS / "stop/damping", part_of("stop", "damping", 5)
  folders = [
    cut(folder, tmp_path / name / "damping", seeds)
    for name, seeds in (("a", [0, 1]), ("b", [2, 3, 4]))
  ]
  for piece, seed in zip(folders, (1, 2)):
    (piece / f"agents/oracle-{seed}").mkdir(parents=True)
    arrays.write(piece / f"agents/oracle-{seed}/agent.npz", {"weights": np.full(3, seed)})
    rows = [
      (r["stream"], r["arm"], r["seed"], step)
      for r in tables.read_rows(piece / "runs.parquet")
      for step in (0, 1)
    ]
    tables.write_table(
      piece / "residuals.parquet",
      {k: list(v) for k, v in zip(("stream", "arm", "seed", "step"), zip(*rows))}
      | {"height": [float(s) for _, _, s, _ in rows]},
    )
  for out, theirs in (
    (tmp_path / "joined", [tmp_path / "a", tmp_path / "b"]),
    (tmp_path / "whole", [tmp_path / "joined"]),
  ):
    bench.take(out, [part], bench.offers(out, [part], theirs))
    found = (out / "damping/agents").rglob("agent.npz")
    assert {p.parent.name: arrays.read(p)["weights"].tolist() for p in found} == {
      "oracle-1": [1, 1, 1],
      "oracle-2": [2, 2, 2],
    }
    rows = tables.read_rows(out / "damping/residuals.parquet")
    assert [(r["stream"], r["arm"], r["seed"], r["step"]) for r in rows] == [
      (5 * a + seed, arm, seed, step)
      for a, arm in enumerate(part.config.arms)
      for seed in range(5)
      for step in (0, 1)
    ]
    assert all(r["height"] == r["seed"] for r in rows)


def test_pieces_that_do_not_fit_are_one_line(tmp_path):
  folder, config = RESULTS / "paper/walker", part_of("paper", "walker").config
  a, b, c = (
    cut(folder, tmp_path / name, seeds)
    for name, seeds in (("a", [0, 1, 2]), ("b", [2, 3]), ("c", [5, 6, 7, 8, 9]))
  )
  with pytest.raises(UserError, match="seed 2 lies both in .*a and in .*b"):
    merge.choose([a, b, c], config)
  with pytest.raises(UserError, match="no seed 3, 4; run what is missing with --first-seed 3"):
    merge.choose([a, c], config)
  assert merge.choose([tmp_path / "nothing"], config) == []
  with pytest.raises(
    UserError, match="c holds seeds 5 to 9, asked for are 0 to 6; give --first-seed"
  ):
    merge.choose([a, c], part_of("paper", "walker", 7).config)
  strange = json.loads((b / "config.json").read_text())
  for key in ("physics", "agent_card"):
    tables.write_json(b / "config.json", strange | {key: "another"})
    with pytest.raises(UserError, match=f"no pieces of one run: they differ in {key}$"):
      merge.join([a, b], tmp_path / "all", config)
  tables.write_json(b / "config.json", {k: v for k, v in strange.items() if k != "first_seed"})
  with pytest.raises(FileError, match="config.json is not a run's: it does not say its seeds"):
    merge.choose([a, b], config)
  tables.write_json(b / "config.json", strange)
  whole = json.loads((b / "summary.json").read_text())
  tables.write_json(b / "summary.json", {k: v for k, v in whole.items() if k != "wall_s"})
  with pytest.raises(FileError, match="summary.json is not a run's: it lacks wall_s$"):
    merge.join([a, b], tmp_path / "all", config)
  tables.write_json(b / "summary.json", whole)
  other = json.loads((c / "config.json").read_text())
  tables.write_json(c / "config.json", other | {"steps": 24_000})
  with pytest.raises(UserError, match="steps"):
    merge.choose([a, c], config)
  shutil.rmtree(c)
  (b / "runs.parquet").write_bytes(b"PAR1")
  with pytest.raises(FileError, match="runs.parquet"):
    merge.join([a, b], tmp_path / "all", config)
  assert not (tmp_path / "all/summary.json").exists()  # no finished run


@contextlib.contextmanager
def held(folder):
  """Another process writes into the folder meanwhile."""
  code = "import sys; from mjx_cl.io import folders\nwith folders.alone(sys.argv[1]):\n"
  code += "  print('in', flush=True); sys.stdin.read()"
  with subprocess.Popen(
    [sys.executable, "-c", code, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
  ) as other:
    assert other.stdout.readline() == b"in\n"
    yield
    other.communicate(b"")


def test_of_another_version_or_in_use_is_not_taken(tmp_path):
  """A part that another process is living stays its own."""
  part = part_of("stop", "damping")
  folder = cut(RESULTS / "stop/damping", tmp_path / "a/damping", [0, 1])
  config = dataclasses.replace(part.config, seeds=2)
  assert merge.differs(folder, config) is None
  own = json.loads((folder / "config.json").read_text())
  tables.write_json(folder / "config.json", own | {"benchmark": 9})
  assert "another benchmark" in merge.differs(folder, config)
  busy = tmp_path / "out/damping"
  busy.mkdir(parents=True)
  (busy / "mine").write_text("x")
  with held(busy), pytest.raises(UserError, match="is being written by another"):
    bench.take(tmp_path / "out", [part._replace(name="damping")], {"damping": [folder]})
  assert (busy / "mine").exists()
  bench.take(tmp_path / "out", [part._replace(name="damping")], {"damping": [folder]})
  assert (busy / "summary.json").exists() and not (busy / "mine").exists()


def test_a_suite_is_one_processs_alone(refused, tmp_path):  # noqa: F811
  """Parts are run by settings that the folder holds, which another suite would replace."""
  with held(tmp_path):
    for command in (["bench", "quick"], ["run", "walker", "--fault", "gear", "bias"]):
      assert "is being written by another" in refused(2, *command, "--out", tmp_path)
  assert not list(tmp_path.iterdir())


def test_bench_joins_and_publishes(mjx, refused, tmp_path):  # noqa: F811
  """`bench --merge` of folders with other seeds, as a user calls it; files of an earlier
  publication that no longer exist go.
  """
  folder, out = RESULTS / "stop/damping", tmp_path / "out"
  for name, seeds in (("one", [0, 1]), ("two", [2, 3])):
    cut(folder, tmp_path / name / "damping", seeds)
  old = tmp_path / "results/damping"
  old.mkdir(parents=True)
  (old / "figure.png").write_bytes(b"of two seeds")
  call = ("bench", "stop", "--only", "damping", "--out", out)
  message = refused(2, *call, "--seeds", "5", "--merge", tmp_path / "one", tmp_path / "two")
  assert "no seed 4;" in message and not (out / "damping").exists()
  code, text, err = mjx(
    *call,
    "--seeds",
    "4",
    "--merge",
    tmp_path / "two",
    tmp_path / "one",
    "--publish",
    tmp_path / "results",
    "--json",
  )
  value = json.loads(text)
  assert (
    code == 0
    and "damping: taken over" in err
    and value["entries"]["damping"]["arms"]["oracle"]["seeds"] == 4
  )
  assert (
    value["entries"]["damping"]["scores"]["recovery"]["oracle"]["n"]
    == value["entries"]["damping"]["arms"]["oracle"]["affected"]
  )
  assert (
    not (old / "figure.png").exists()
    and (old / "stop.parquet").exists()
    and (old / "snapshots.parquet").exists()
  )
  rows = tables.read_rows(tmp_path / "results/bench.parquet")
  assert [(r["arm"], r["seed"]) for r in rows] == [
    (arm, seed) for arm in ("oracle", "oracle-budget", "none") for seed in range(4)
  ]
  assert np.isfinite([r["reward_final"] for r in rows]).all()


@pytest.mark.parametrize("broken", ["agent.npz", "card.json"])
def test_a_broken_agent_is_said_and_no_agent_is_none(tmp_path, broken):
  """Damage is no agent that was moved: nothing is known of how the run differs."""
  config = RunConfig("walker", agent=str(tmp_path / "own"))
  assert merge.cards(config) == {}
  shutil.copytree(agents.HERE / "walker", tmp_path / "own")
  assert merge.cards(config)["agent_card"]["env"] == "walker"
  merge._cards.cache_clear()
  file = tmp_path / "own" / broken
  file.write_bytes(file.read_bytes()[:-100])
  with pytest.raises(FileError, match=broken):
    merge.cards(config)
  part = suites.Part("x", config)
  with pytest.raises(FileError, match=f"^part x: .*{broken}"):
    costs.check(part, costs.Robots())
