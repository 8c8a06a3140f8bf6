"""Robots, faults and detectors of other packages: the class of docs/extending.md as a robot, one
module with all three, and broken ones.
"""

import dataclasses
import importlib.metadata
import json
import os
import pathlib
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl import detectors, envs, faults
from mjx_cl.cli import app
from mjx_cl.cli.flags import List, Run
from mjx_cl.errors import PluginError, UserError
from mjx_cl.io import plugins, tables
from mjx_cl.io.plugins import Registry
from mjx_cl.rollout.monitor import unknown

ROOT = pathlib.Path(__file__).parents[2]
EXTENDING = (ROOT / "docs/extending.md").read_text()
REACH = re.search(r"class Reach:.*?\n\n\n", EXTENDING, re.S)[0]  # as a reader copies it
PLUG = f'''import jax, jax.numpy as jnp
from mjx_cl.detectors import Alarm, Detector, scalar
from mjx_cl.faults.base import fault
from mjx_cl.types import EnvState, Model, Spec, Step, Var

{REACH}
def sticky(env):
  """The first command sticks at 0.

  Severity: 1 holds it [1]. Target: the command. Owns `ctrl`. Source: made up.
  """
  return fault("sticky", env, ("ctrl",), ("all",), lambda hit, memory, severity, key, ports: (memory, {{"ctrl": ports.ctrl * (1.0 - severity)}}))

@scalar
def level(threshold: float = 3.0):
  """A level."""
  return Detector(lambda: (), lambda state, x: (state, Alarm(x > threshold, x)))

def broken(env):
  return 1 / 0
'''


@pytest.fixture
def package(tmp_path):
  """package(entries, code): environment variables in which a package `plug` with these entry points
  is installed.
  """

  def make(entries: str, code: str = PLUG) -> dict:
    (tmp_path / "plug.py").write_text(code)
    info = tmp_path / "plug-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plug\nVersion: 1\n")
    (info / "entry_points.txt").write_text(entries)
    return os.environ | {
      "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)]),
      "JAX_PLATFORMS": "cpu",
    }

  return make


def mjx(env, *argv):
  return subprocess.run(
    [sys.executable, "-m", "mjx_cl", *argv], env=env, capture_output=True, text=True, cwd=ROOT
  )


def test_one_module_brings_robot_fault_and_detector(package):
  """It imports this package's modules while these look for it, in whatever order the tables are
  used.
  """
  env = package(
    "[mjx_cl.envs]\nreach = plug:Reach\n[mjx_cl.faults]\nsticky = "
    "plug:sticky\n[mjx_cl.detectors]\nlevel = plug:level\n"
  )
  for what, name in (("envs", "reach"), ("faults", "sticky"), ("detectors", "level")):
    out = mjx(env, "list", what, "--json")
    assert out.returncode == 0 and name in json.loads(out.stdout)[what], out.stderr
  code = """
from mjx_cl import envs, faults, detectors
env = envs.make("reach")
print(type(env).__name__, faults.make("sticky", env).owns, faults.family("sticky"), "sticky" in faults.available(env), detectors.make("level", threshold=2.0) is not None)
"""
  out = subprocess.run(
    [sys.executable, "-c", code], env=env, capture_output=True, text=True, cwd=ROOT
  )
  assert out.stdout.split("\n")[0] == "Reach ('ctrl',) plugin True True", out.stderr
  out = mjx(env, "eval", "reach", "--physics", "mjx")
  assert (
    out.returncode == 2
    and out.stderr.strip().count("\n") == 0
    and "no physics backend" in out.stderr
  )


@pytest.mark.parametrize(
  "entries, argv, words",
  [
    (
      "[mjx_cl.envs]\nx = nowhere:Robot\n",
      ("list", "envs"),
      "environment 'x' of nowhere:Robot cannot be loaded: ModuleNotFoundError",
    ),
    (
      "[mjx_cl.faults]\nboom = plug:broken\n",
      ("run", "walker", "--fault", "boom", "--out", os.devnull + "/x"),
      "fault 'boom' cannot be built for robot 'walker': ZeroDivisionError",
    ),
    (
      "[mjx_cl.faults]\ngear = plug:sticky\n",
      ("list", "faults"),
      "fault 'gear' of plug:sticky is there already",
    ),
  ],
)
def test_a_broken_plug_in_is_one_line(package, tmp_path, entries, argv, words):
  out = mjx(
    package(entries), *[str(tmp_path / "out") if a.startswith(os.devnull) else a for a in argv]
  )
  assert (
    out.returncode == 1
    and words in out.stderr
    and out.stderr.strip().count("\n") == 0
    and not out.stdout
  )


def test_what_is_not_used_breaks_nothing(package):
  assert mjx(package("[mjx_cl.envs]\nx = nowhere:Robot\n"), "list", "detectors").returncode == 0


def test_the_readme_robot_is_built_with_and_without_physics(monkeypatch):
  space = {}
  exec(
    "import jax, jax.numpy as jnp\nfrom mjx_cl.types import EnvState, Model, Spec, Step, Var\n"
    + REACH,
    space,
  )

  class Choosy(space["Reach"]):
    def __init__(self, physics="auto"):
      self.physics = physics

  entry = lambda name, value: type(
    "Entry", (), {"name": name, "value": f"mine:{name}", "load": staticmethod(lambda: value)}
  )
  monkeypatch.setattr(
    importlib.metadata,
    "entry_points",
    lambda group: [
      entry("reach", space["Reach"]),
      entry("choosy", Choosy),
      entry("bad", lambda: 1 / 0),
    ],
  )
  monkeypatch.setattr(
    envs,
    "ENVS",
    Registry(
      "mjx_cl.envs", "environment", {name: envs.ENVS.members[name] for name in envs.ENVS.own}
    ),
  )
  robot = envs.make("reach")
  state, obs = robot.init(robot.model, jax.random.key(0))
  assert robot.step(robot.model, state, jnp.ones(1))[1].obs.shape == obs.shape == (2,)
  assert envs.make("choosy", "native").physics == "native" and [
    name for name in envs.ENVS if name not in envs.ENVS.own
  ] == ["reach", "choosy", "bad"]
  with pytest.raises(UserError, match="no physics backend"):
    envs.make("reach", "mjx")
  with pytest.raises(PluginError, match="'bad' cannot be built: ZeroDivisionError"):
    envs.make("bad")


def test_a_registry_is_read_like_a_dict_and_filled_once(monkeypatch):
  loads = []
  entry = type(
    "Entry",
    (),
    {
      "name": "b",
      "value": "mine:b",
      "load": staticmethod(lambda: loads.append(len(table)) or (lambda: "b")),
    },
  )
  monkeypatch.setattr(
    importlib.metadata, "entry_points", lambda group: [entry] if group == "g" else []
  )
  table = Registry("g", "thing", {"a": print})
  assert (
    sorted({**table}) == ["a", "b"]
    and len(table) == 2
    and "b" in table
    and table.get("c") is None
    and [*table.items()][0] == ("a", print)
  )
  assert loads == [1]  # what looks into the table while it is filled sees what is there
  assert set(detectors.DETECTORS.own) <= set(detectors.DETECTORS) and faults.FAULTS.own == set(
    faults.FAULTS
  )


def test_settings_of_a_wrong_kind_are_one_line(capsys, tmp_path):
  for argv, words in (
    ((), "rolling_sigma"),
    (("--detector", "cusum"), "cusum"),
    (("--detector", "ewma"), "ewma"),
  ):
    assert (
      app.main(["run", "walker", "--set", "threshold=abc", "--out", str(tmp_path / "r"), *argv])
      == 2
    )
    err = capsys.readouterr().err
    assert (
      f"detector '{words}': threshold takes float; got 'abc'" in err
      and err.strip().count("\n") == 0
    )
  assert app.main(["run", "walker", "--set", "foo=3", "--out", str(tmp_path / "r")]) == 2
  assert (
    "window" in (err := capsys.readouterr().err)
    and "threshold_rpr" in err
    and not (tmp_path / "r").exists()
  )


def test_json_is_one_value_whatever_a_detector_prints(tmp_path, capfd):
  """A user's class prints at every sample; standard output holds the JSON value alone, and is whole
  again afterwards.
  """
  (tmp_path / "mine.py").write_text(
    "class Prints:\n  def update(self, x):\n    print('seen', x)\n    return False\n"
  )
  rows = "\n".join(["a,b"] + [f"{k % 7},{k % 5}" for k in range(400)])
  for name in ("log", "nominal"):
    (tmp_path / f"{name}.csv").write_text(rows + "\n")
  argv = [
    "detect",
    str(tmp_path / "log.csv"),
    "--nominal",
    str(tmp_path / "nominal.csv"),
    "--detector",
    f"{tmp_path}/mine.py:Prints",
    "--out",
    str(tmp_path / "out"),
  ]
  assert app.main([*argv, "--json"]) == 0
  out, err = capfd.readouterr()
  assert isinstance(json.loads(out), dict) and "seen 3.0" in err
  assert (
    app.main(["list", "arms", "--json"]) == 0
    and "detector" in json.loads(capfd.readouterr().out)["arms"]
  )


def test_what_a_run_takes_with_a_doubt_and_what_it_refuses(capsys, tmp_path):
  from mjx_cl.config import AdaptConfig, RunConfig, replace
  from mjx_cl.runs import doubts

  config = lambda **adapt: RunConfig(
    "walker", onset=600, steps=1500, adapt=replace(AdaptConfig(), **adapt)
  )
  assert "onset 600 lies within adapt.warmup=1,000" in doubts.doubts(config())[
    0
  ] and not doubts.doubts(config(warmup=500))
  assert "the run ends at step 1,500, within" in doubts.doubts(config(warmup=5000))[0]
  [late] = doubts.doubts(config(warmup=500, start_windows=1500))
  assert "adapt.start_windows=1,500 is more than the replay of 1,500 steps ever holds" in late
  [deaf] = doubts.doubts(replace(config(), arms=("none",)))  # nobody listens
  assert "no stream counts as affected" in deaf and "alarm" not in deaf
  assert "before its fault at 1,500" in doubts.doubts(replace(config(), onset=1500))[
    0
  ] and not doubts.doubts(replace(config(), onset=1500, fault="none"))
  assert (
    "adapt.budget=3,000 ends every finetuning before"
    in doubts.doubts(replace(config(warmup=500, budget=3000)))[0]
  )
  for argv, words in (
    (("--adapt.warmup", "-1"), "warmup must be a whole number in 0"),
    (("--fault", "gera"), "unknown fault"),
  ):
    assert app.main(["run", "walker", "--out", str(tmp_path / "r"), *argv]) == 2
    assert (
      words in capsys.readouterr().err and not (tmp_path / "r").exists()
    )  # an empty folder is no run either


def test_a_detector_in_the_loop_has_the_boards_threshold(tmp_path, monkeypatch):
  """The one that is built, that config.json names and that the note tells are one; `--resume` and
  `--merge` take no other.
  """
  from mjx_cl.config import RunConfig
  from mjx_cl.detectors.base import Detector
  from mjx_cl.runs import merge, run

  built = []
  monkeypatch.setattr(
    detectors,
    "make",
    lambda name, **settings: (
      built.append((name, settings)) or Detector(lambda: (), lambda state, x: (state, None))
    ),
  )
  config = RunConfig(
    "car",
    fault="noise",
    detector="cusum",
    settings={"whiten": 8, "slack": 0.5},
    seeds=1,
    steps=64,
    onset=10,
  )
  row = detectors.board()["car"]["cusum white"]
  runner, told = run.Runner(config, tmp_path / "r"), []
  assert built == [
    (
      "cusum",
      {"robot": "car", "agent": "car", "whiten": 8, "slack": 0.5, "threshold": row["threshold"]},
    )
  ]
  value = runner.config_dict()
  assert (
    value["threshold"] == {"value": row["threshold"], "arl0": row["arl0"], "alarms": row["alarms"]}
    and "threshold" not in value["settings"]
  )
  monkeypatch.setattr(run.Runner, "step", lambda self: 1 / 0)
  with pytest.raises(ZeroDivisionError):
    run.execute(config, tmp_path / "r", tell=told.append)
  assert told[0] == (
    "note: detector cusum at threshold "
    + (
      f"{row['threshold']:.6g}, at which the shipped car gave 33 false alarms in 3,384,480 "
      "healthy control steps, one in 102,560 [73,029, 148,993]"
    )
  )
  held = json.loads((tmp_path / "r" / "config.json").read_text())
  for other in (
    None,
    held["threshold"] | {"value": 7.0},
  ):  # of a version that had no such threshold, or another
    (tmp_path / "r" / "config.json").write_text(
      json.dumps(
        {k: v for k, v in held.items() if k != "threshold"}
        | ({"threshold": other} if other else {})
      )
    )
    with pytest.raises(UserError, match="another default threshold than today; --overwrite"):
      run.execute(config, tmp_path / "r", resume=True)
    (tmp_path / "r" / "summary.json").write_text("{}")
    with pytest.raises(UserError, match="another default threshold than today; --overwrite"):
      merge.seeds_of(tmp_path / "r", config)
    (tmp_path / "r" / "summary.json").unlink()
  (tmp_path / "r" / "config.json").write_text(json.dumps(held))
  with pytest.raises(UserError, match="another settings, threshold"):
    run.execute(
      dataclasses.replace(config, settings={"whiten": 8, "threshold": 3.0}),
      tmp_path / "r",
      resume=True,
    )


@pytest.mark.parametrize(
  "robot, detector, change, text",
  [
    ("walker", "ewma", {}, "the shipped walker gave 33 false alarms"),
    ("car_real", "ewma", {}, "148,993]; this run has another env"),
    (
      "walker",
      "hotelling",
      {"agent": "walker-plain", "form": "streaming"},
      "another agent and form",
    ),
    (
      "walker",
      "cusum",
      {"settings": {"whiten": 4}},
      "its own default threshold, 8: none was found for walker",
    ),
    ("walker", "kswin", {}, "its own default threshold"),
    ("car", "bfar", {"settings": {"rate": 0.5}}, "--set threshold=..."),
    (
      "walker",
      "innovations",
      {"agent": "walker-2"},
      "1.58345, at which the shipped walker-2 gave 12",
    ),
    ("walker", "ewma", {"agent": "walker-2"}, "shipped walker gave"),
    ("walker", "ewma", {"settings": {"threshold": 3.0}}, None),
    ("walker", "ewma", {"arms": ("none", "oracle")}, None),
    ("walker", "never", {}, None),
    ("walker", "always", {}, None),
    ("walker", "random", {}, None),
    ("walker", "rolling_sigma", {}, None),
    ("quadruped", "rolling_sigma", {"agent": "quadruped-trot-3"}, None),
    ("car_real", "rolling_sigma", {}, None),
    ("FILE:Reach", "rolling_sigma", {}, "calibrated for walker, at threshold 6.5: it is not calib"),
    ("FILE:Reach", "rolling_sigma", {"settings": {"threshold": 9.0}}, None),
    ("FILE:Reach", "rolling_sigma", {"arms": ("none", "oracle")}, None),
    ("FILE:Reach", "rolling_sigma_plain", {}, None),
    ("walker", "rolling_sigma_plain", {}, None),
    ("walker", "rolling_sigma_FILE", {}, "its own default threshold, 4:"),
  ],
)
def test_what_a_detector_runs_with_is_said(robot, detector, change, text, tmp_path):
  from mjx_cl.config import RunConfig
  from mjx_cl.runs import doubts

  if detector.endswith("FILE"):
    (tmp_path / "rolling_sigma_mine.py").write_text(
      "from mjx_cl.detectors.cusum import cusum\ndef mine(threshold=4.0):\n  return "
      "cusum(threshold=threshold)\n"
    )
    detector = f"{tmp_path}/rolling_sigma_mine.py:mine"
  (tmp_path / "reach.py").write_text(PLUG)
  robot = robot.replace("FILE", f"{tmp_path}/reach.py")
  said = doubts.watching(RunConfig(robot, fault="noise", detector=detector, **change))
  assert said is None if text is None else text in said


def test_a_board_is_not_replaced_unasked(capsys, tmp_path):
  (tmp_path / "board").mkdir()
  (tmp_path / "board" / "leaderboard.json").write_text("{}")
  assert (
    app.main(["leaderboard", "--out", str(tmp_path / "board")]) == 2
    and "--overwrite" in capsys.readouterr().err
  )
  (tmp_path / "file").write_text("")
  assert (
    app.main(["leaderboard", "--out", str(tmp_path / "file")]) == 2
    and "is a file" in capsys.readouterr().err
  )
  assert (tmp_path / "board" / "leaderboard.json").read_text() == "{}"


def test_an_agent_of_nan_has_no_return(capsys, tmp_path, monkeypatch):
  from mjx_cl.training import evaluate

  monkeypatch.setattr(
    evaluate,
    "evaluate",
    lambda *a: {
      "return_mean": float("nan"),
      "return_iqm": float("nan"),
      "return_ci": None,
      "terminations": 0,
    },
  )
  for more in ((), ("--json",)):
    assert app.main(["eval", "walker", "--episodes", "1", *more]) == 1
    out, err = capsys.readouterr()
    assert not out and "no number" in err and err.strip().count("\n") == 0


def test_what_does_not_fit_is_one_line(capsys, monkeypatch):
  """XLA's own words for it; other errors of the run time stay what they are."""
  from mjx_cl.cli import doctor

  monkeypatch.setattr(
    doctor,
    "report",
    lambda: (_ for _ in ()).throw(
      RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8029696929576 bytes.")
    ),
  )
  assert (
    app.main(["doctor"]) == 1
    and "out of memory" in (err := capsys.readouterr().err)
    and err.strip().count("\n") == 0
  )
  monkeypatch.setattr(doctor, "report", lambda: (_ for _ in ()).throw(RuntimeError("a bug")))
  with pytest.raises(RuntimeError, match="a bug"):
    app.main(["doctor"])


def test_a_pure_detector_of_a_file_is_made_and_a_plain_class_is_told_where_to_go(tmp_path, capsys):
  (tmp_path / "mine.py").write_text(
    PLUG + "\nclass Plain:\n  def update(self, x):\n    return x > 1\n"
  )
  detector = detectors.make(f"{tmp_path}/mine.py:level", channel="opr", log=False, threshold=2.0)
  residual = unknown((), 4)._replace(valid=jnp.bool_(True))
  (tmp_path / "a@b").mkdir()
  (tmp_path / "a@b" / "mine.py").write_text(PLUG)
  assert isinstance(detectors.make(f"{tmp_path}/a@b/mine.py:level@rpr"), detectors.Detector)
  fired = [
    bool(detector.update(detector.init(), residual._replace(opr=jnp.float32(x)))[1].fired)
    for x in (1.0, 3.0)
  ]
  assert fired == [False, True]
  for name, words in (
    ("Plain", "leaderboard --add"),
    ("Nobody", "nothing of the name 'Nobody'"),
    ("level", "wrong_setting"),
  ):
    more = ("--set", "wrong_setting=1") if name == "level" else ()
    assert (
      app.main(
        [
          "run",
          "walker",
          "--detector",
          f"{tmp_path}/mine.py:{name}",
          "--out",
          str(tmp_path / "r"),
          *more,
        ]
      )
      == 2
    )
    err = capsys.readouterr().err
    assert words in err and err.strip().count("\n") == 0 and not (tmp_path / "r").exists()


def test_robot_and_fault_of_a_file(tmp_path, capsys, tiny):
  """As of a package: built, proven to act, trained agents fit by the robot's own name; the robot
  names no physics.
  """
  import dataclasses

  from mjx_cl.config import RunConfig
  from mjx_cl.faults.presets import changes
  from mjx_cl.runs import certify, identity, run, settings
  from mjx_cl.training import agents

  (tmp_path / "mine.py").write_text(PLUG + "class Bare: pass\nrepr = repr\n")
  robot, broken = (f"{tmp_path}/mine.py:{name}" for name in ("Reach", "sticky"))
  env = envs.make(robot)
  assert (
    type(env) is type(envs.make(robot))
    and type(env).__name__ == "Reach"
    and robot in envs.ENVS
    and robot not in [*envs.ENVS]
  )
  assert (
    faults.make(broken, env).owns == ("ctrl",)
    and faults.family(broken) == "plugin"
    and faults.family("none") == "none"
    and faults.family("gear") == "actuator"
  )
  assert "plugin: The first command sticks" in faults.about(broken)
  rows = certify.certify(robot, episodes=0, only=(broken,))
  acts = [r for r in rows if r["fault"] == broken and r["severity"] > 0]
  assert (
    acts
    and all(not r["identical"] and r["first_step"] == 0 and r["physics"] == "jax" for r in acts)
    and not certify.certificate.faulty(
      [
        certify.certificate.Certificate(*(r[k] for k in certify.certificate.Certificate._fields))
        for r in rows
      ]
    )
  )

  config = settings.check(
    RunConfig(
      robot,
      fault=broken,
      steps=256,
      onset=128,
      seeds=1,
      agent=str(tmp_path / "agent"),
      detector=f"{tmp_path}/mine.py:level@rpr",
    )
  )
  assert (
    config.severity == 0.5 and changes(config)[0].fault == broken
  )  # no preset, for all its slashes
  agents.save(
    tmp_path / "agent",
    jax.jit(type(tiny)(tiny.config, 2, 1).init)(jax.random.key(0)),
    {"env": "reach", "preset": "tiny", "repeat": 1, "dreamer": dataclasses.asdict(tiny.config)},
  )
  held = run.Runner(config, tmp_path / "run").config_dict()
  assert (
    held["physics"] == "jax"
    and len(set(held["files"].values())) == 1
    and set(held["files"]) == {robot, broken, config.detector}
  )
  (tmp_path / "run").mkdir(exist_ok=True)
  tables.write_json(tmp_path / "run" / "config.json", held)
  unresolved = lambda: {k: v for k, v in identity.identity(config).items() if k != "physics"}
  identity.check_same(tmp_path / "run", unresolved())
  (tmp_path / "mine.py").write_text(PLUG + "class Bare: pass\nrepr = repr  # another one\n")
  with pytest.raises(
    UserError, match="another files"
  ):  # what the path holds now is not what the run began with
    identity.check_same(tmp_path / "run", unresolved())
  assert "files" not in identity.identity(RunConfig("walker"))

  (tmp_path / "circle.py").symlink_to("circle.py")
  for argv, words in (
    (("eval", f"{tmp_path}/circle.py:Robot"), "circle.py"),
    (("eval", f"{tmp_path}/mine.py:Nobody"), "nothing of the name 'Nobody'"),
    (("eval", "nowhere.py:Robot"), "no file nowhere.py"),
    (("eval", "no_such_module:Robot"), "no module 'no_such_module' is installed"),
    (("eval", ":x"), "give module:Name or"),
    (
      ("run", "walker", "--fault", f"{tmp_path}/mine.py:broken", "--out", str(tmp_path / "r")),
      f"({tmp_path}/mine.py, line ",
    ),
    (
      ("run", "walker", "--fault", f"{tmp_path}/mine.py:repr", "--out", str(tmp_path / "r")),
      "gives str in place of a Fault",
    ),
    (
      ("run", "walker", "--fault", "~nobodyhere/mine.py:x", "--out", str(tmp_path / "r")),
      "no file ~nobodyhere/mine.py",
    ),
    (
      ("eval", f"{tmp_path}/mine.py:Bare"),
      "gives Bare, which has no spec and no model and no init and no step",
    ),
  ):
    code = app.main([*argv])
    err = capsys.readouterr().err
    assert (
      code in (1, 2)
      and words in err
      and err.strip().count("\n") == 0
      and not (tmp_path / "r").exists()
    ), err


def test_a_file_robot_that_is_a_shipped_one_by_another_path(tmp_path, capsys):
  """A subclass goes by the name in its spec: it takes that robot's agent, or that of `agents_of`,
  and cannot overwrite its costs unasked.
  """
  import types

  from mjx_cl.leaderboard import record
  from mjx_cl.runs import certificate_tables
  from mjx_cl.training import agents

  (tmp_path / "mine.py").write_text(
    "from mjx_cl.envs.walker import Walker\n\nclass Mine(Walker):\n  pass\n"
  )
  mine = envs.make(f"{tmp_path}/mine.py:Mine")
  assert agents.is_shipped(mine) and agents.of(mine).card["env"] == "walker"
  car = envs.make("car").spec
  heir = types.SimpleNamespace(spec=car._replace(name="fast:car"), agents_of="car")
  assert agents.is_shipped(heir) and agents.of(heir).card["env"] == "car"
  heir.agents_of = None
  assert not agents.is_shipped(heir)
  training = tmp_path / "training"
  (training / "agent").mkdir(parents=True)
  (training / "agent" / "card.json").write_text("{}")
  with pytest.raises(UserError, match="is a training; its agent is .*training/agent"):
    agents.load(str(training), "car", 1, 1)
  with pytest.raises(UserError, match="no agent ships for 'reach': give one with --agent; mjx-cl"):
    agents.load(None, "reach", 1, 1)
  with pytest.raises(UserError, match="no agent ships for 'fast:car'"):
    agents.of(heir)
  tables.write_table(
    tmp_path / "certificates.parquet",
    {
      k: ["walker" if k == "robot" else 20 if k == "episodes" else None]
      for k in certificate_tables.COLUMNS
    },
  )
  for name in ("walker", f"{tmp_path}/mine.py:Mine"):
    with pytest.raises(UserError, match="holds measured costs of walker"):
      certificate_tables.guard(tmp_path, (name,), 0)
    certificate_tables.guard(tmp_path, (name,), 20)
  name = f"{tmp_path}/mine.py:Mine"
  with pytest.raises(UserError, match="register it"):
    record.prepare(types.SimpleNamespace(name="s", robots={name: {}}), (), "auto", None)


def test_a_file_imports_what_lies_beside_it(tmp_path):
  (tmp_path / "lies_beside.py").write_text("def level(): return 7\n")
  (tmp_path / "own.py").write_text("from lies_beside import level\n")
  before = list(sys.path)
  assert plugins.find(f"{tmp_path}/own.py:level", "detector")() == 7
  assert sys.path == before


def test_files_of_two_folders_have_helpers_of_one_name(tmp_path):
  """Each its own, at once and when one is loaded anew; what is imported belongs to the identity."""
  for name, level in (("a", 1), ("b", 2)):
    (tmp_path / name).mkdir()
    (tmp_path / name / "common.py").write_text(f"import deeper\nLEVEL = {level}\n")
    (tmp_path / name / "deeper.py").write_text("")
    (tmp_path / name / "own.py").write_text("import common\ndef level(): return common.LEVEL\n")
  find = lambda name: plugins.find(f"{tmp_path}/{name}/own.py:level", "detector")
  assert [find("a")(), find("b")(), find("a")()] == [1, 2, 1]
  names = [path.name for path in plugins.files(tmp_path / "a" / "own.py")]
  assert names == ["own.py", "common.py", "deeper.py"]


def test_a_fault_that_fails_its_certificate_fails_the_command(tmp_path, capsys):
  (tmp_path / "noop.py").write_text(
    "from mjx_cl.faults.base import fault\n"
    "def noop(env):\n"
    "  act = lambda row, memory, severity, key, ports: (memory, {'ctrl': ports.ctrl})\n"
    "  return fault('noop', env, ('ctrl',), ('all',), act)\n"
  )
  argv = ["certify", "walker", "--fault", f"{tmp_path}/noop.py:noop", "--episodes", "0"]
  assert app.main([*argv, "--out", str(tmp_path / "out")]) == 1
  assert "certificates fail" in capsys.readouterr().err


def test_what_a_users_code_gave_and_ours_cannot_use_names_that_code():
  own = Run("walker", detector="mine/bad.py:d", arms=("none",))
  with pytest.raises(PluginError, match="^mine/bad.py:d: TypeError: no such form"), app.ours(own):
    raise TypeError("no such\n form")
  with pytest.raises(TypeError), app.ours(Run("walker")):  # of this package: a bug
    raise TypeError("no such form")


def test_a_memory_keeps_its_form():
  env = envs.make("walker")
  act = lambda row, memory, severity, key, ports: (jnp.zeros(2), {"ctrl": ports.ctrl})
  made = faults.base.fault("mine", env, ("ctrl",), ("all",), act, memory=jnp.zeros(6))
  ports = faults.base.Ports(env.model, ctrl=jnp.zeros(6))
  with pytest.raises(PluginError, match=r"form float32\[2\] of one of form float32\[6\]"):
    made.apply(made.init(jax.random.key(0)), jnp.float32(0.5), jax.random.key(1), ports)


def test_rows_of_a_fault_are_of_its_targets():
  env = envs.make("walker")
  make = lambda **how: faults.base.fault(
    "mine", env, ("ctrl",), ("a", "b", "c"), lambda *_: ((), {}), **how
  )
  assert make(rows=np.zeros((3, 6)), drawn=2).drawn == 2
  with pytest.raises(PluginError, match="rows of shape .2, 6. for 3 targets"):
    make(rows=np.zeros((2, 6)))
  with pytest.raises(PluginError, match="draws from 4 targets; it has 3"):
    make(drawn=4)


def test_the_fault_of_the_docs(tmp_path):
  """The example of docs/faults.md as a file of one's own, against a loop by hand: target hit alone,
  band, an episode's start, severity 0.
  """
  text = (ROOT / "docs/faults.md").read_text()
  (block,) = [
    b for b in re.findall(r"^```python\n(.*?)^```", text, re.S | re.M) if "# sticky.py" in b
  ]
  (tmp_path / "mine.py").write_text(block)
  env = envs.make("walker")
  fault = faults.make(f"{tmp_path / 'mine.py'}:sticky", env)
  assert fault.targets[:2] == ("right_hip", "right_knee") and fault.owns == ("ctrl",)
  commands = np.random.default_rng(0).uniform(-1, 1, (40, 6)).astype(np.float32)
  step = jax.jit(
    lambda state, severity, ctrl, first: fault.apply(
      state, severity, jax.random.key(0), faults.Ports(env.model, ctrl=ctrl, first=first)
    )
  )
  for severity in (0.0, 0.8):
    state, held, differs = fault.init(jax.random.key(0), 1), np.zeros(6, np.float32), 0
    for t, ctrl in enumerate(commands):
      state, ports = step(state, jnp.float32(severity), ctrl, jnp.bool_(t in (0, 20)))
      held = (
        np.where(np.abs(ctrl - held) > np.float32(0.5) * np.float32(severity), ctrl, held)
        if t not in (0, 20)
        else ctrl
      )
      want = ctrl.copy()
      want[1] = held[1]
      np.testing.assert_array_equal(np.asarray(ports.ctrl), want)
      differs += ports.ctrl[1] != ctrl[1]
    assert (differs > 3) == (severity > 0)


HOSTILE = """
import jax.numpy as jnp, mjx_cl.detectors
from mjx_cl.detectors import Alarm
class Own(BaseException):
  def __str__(self): raise ValueError
def leaves(threshold=1.0): raise SystemExit(0)
def stops(threshold=1.0): raise KeyboardInterrupt
def own(threshold=1.0): raise Own
def number(threshold=1.0): return 7
number.__doc__ = 3.5
def late(threshold=1.0):
  def update(state, x): raise SystemExit(0)
  return mjx_cl.detectors.Detector(lambda: (), update)
def words(threshold=1.0):
  return mjx_cl.detectors.Detector(lambda: (), lambda state, x: "no answer")
def unlike(threshold=1.0):
  return mjx_cl.detectors.Detector(lambda: "no state", lambda state, x: state)
def pair(threshold=1.0):
  alarm = lambda x: Alarm(jnp.array([True, False]), x.opr)
  return mjx_cl.detectors.Detector(lambda: (), lambda state, x: (state, alarm(x)))
def whole(threshold=1.0):
  return mjx_cl.detectors.Detector(lambda: (), lambda state, x: (state, Alarm(1, x.opr)))
def drifts(threshold=1.0):
  answer = lambda state, x: (state + 0.5, Alarm(state > 3, x.opr))
  return mjx_cl.detectors.Detector(lambda: jnp.int32(0), answer)
def grows(threshold=1.0):
  answer = lambda state, x: ((state, state), Alarm(x.opr > 3, x.opr))
  return mjx_cl.detectors.Detector(lambda: 0.0, answer)
def iterates(threshold=1.0):
  return mjx_cl.detectors.Detector(lambda: next(iter(())), lambda state, x: state)
"""


SCALARS = """
import jax.numpy as jnp, numpy as np
from mjx_cl.detectors import Alarm, Detector
def count(threshold=1e9, warmup=10):
  def update(state, x):
    n, mean, seen, squares = state
    new = n + 1, 0.9 * mean + jnp.where(x.valid, x.reward, 0.0), True, np.zeros(2)
    return new, Alarm(n > threshold, mean)
  return Detector(lambda: (0, 0.0, False, np.zeros(2)), update)
"""


def test_a_state_may_hold_numbers_of_python(tmp_path, capfd):
  (tmp_path / "count.py").write_text(SCALARS)
  source, out = f"{tmp_path / 'count.py'}:count", tmp_path / "out"
  short = ("--seeds", "1", "--steps", "192", "--onset", "100", "--arm", "detector")
  short += ("--set", "threshold=100", "--adapt.warmup", "50", "--adapt.refit", "64")
  status = app.main(["run", "walker", *short, "--detector", source, "--out", str(out)])
  assert status == 0, capfd.readouterr().err[-500:]
  assert tables.read_arrow(out / "trace.parquet").num_rows == 192


@pytest.mark.parametrize(
  "name, words",
  [
    ("leaves", "SystemExit: 0"),
    ("stops", "KeyboardInterrupt"),
    ("own", "Own: its message cannot be read"),
    ("number", "gives int in place of a Detector"),
    ("late", "SystemExit: 0"),
    ("words", "update gives str in place of (state, Alarm)"),
    ("unlike", "init gives str in place of arrays"),
    ("pair", "Alarm(fired bool[2], score float32[]) in place of (bool[], float32[])"),
    ("whole", "Alarm(fired int32[], score float32[])"),
    ("drifts", "a state of form float32[] in place of int32[]"),
    ("grows", "a state of form (float32[], float32[]) in place of float32[]"),
    ("iterates", "init raised StopIteration"),
  ],
)
@pytest.mark.parametrize("command", ["run", "leaderboard"])
def test_foreign_code_ends_no_command_but_in_a_line(tmp_path, capfd, command, name, words):
  """Each names the file, and neither ends as if all had gone well, nor as if the user had asked."""
  (tmp_path / "hostile.py").write_text(HOSTILE)
  source, out = f"{tmp_path / 'hostile.py'}:{name}", tmp_path / "out"
  robot = ["walker", "--seeds", "1", "--steps", "64", "--onset", "10"] * (command == "run")
  status = app.main([command, *robot, "--detector", source, "--out", str(out)])
  lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("mjx-cl: ")]
  assert status == (2 if name == "number" else 1) and len(lines) == 1, lines
  assert "hostile.py" in lines[0] and words in lines[0]
  assert not list(out.rglob("summary.json")) and not list(out.rglob("leaderboard.json"))


@pytest.mark.parametrize(
  "step, said",
  [
    ("return None", "step gives NoneType in place of a Step"),
    ("return state, 7", "step gives int in place of a Step"),
    ("raise SystemExit(3)", "cannot be built: SystemExit: 3"),
    ("return state, Step(obs[:1], obs[0], obs[0] > 0, obs[0] > 0, obs[:1])", "spec's 2 variables"),
    ("return state, Step(obs, obs[:1], obs[0] > 0, obs[0] > 0, obs)", r"reward of shape \(1,\)"),
    ("return state, Step(obs, obs[0], obs[0], obs[0] > 0, obs)", "terminated of type float32"),
    ("return state, Step(obs, obs[0], obs[0] > 0, obs[0] > 0, obs[:1])", r"final_obs of shape \(1"),
    (
      "return EnvState(obs, 1.0 * state.step), Step(obs, obs[0], obs[0] > 0, obs[0] > 0, obs)",
      r"a state whose step is float32\[\]; init gave int32\[\]",
    ),
  ],
)
def test_a_robot_that_answers_wrongly_is_one_line(tmp_path, step, said):
  head = "import jax, jax.numpy as jnp\nfrom mjx_cl.types import EnvState, Model, Spec, Step, Var\n"
  robot = re.sub(r"reward, late = .*", step, REACH)
  (tmp_path / "mine.py").write_text(head + robot)
  with pytest.raises(PluginError, match=said) as e:
    envs.make(f"{tmp_path / 'mine.py'}:Reach")
  assert "\n" not in str(e.value)


@pytest.mark.parametrize(
  "own, said",
  [
    ("posture=(2, 0.5)", r"spec.posture: index 2 is not in 0..1"),
    ("posture=None, watched=(('x', (0, 2)),)", r"spec.watched: 'x' must hold indices in 0..1"),
    ("posture=None, watched=(('x', (0,)),) * 9", "spec.watched has 9 parts; at most 8"),
    ("posture=None, act_groups=(('leg', ()),)", r"spec.act_groups: 'leg' must hold indices"),
  ],
)
def test_a_spec_that_does_not_fit_itself_is_one_line(tmp_path, own, said):
  head = "import jax, jax.numpy as jnp\nfrom mjx_cl.types import EnvState, Model, Spec, Step, Var\n"
  (tmp_path / "mine.py").write_text(head + REACH.replace("posture=None", own))
  with pytest.raises(PluginError, match=said):
    envs.make(f"{tmp_path / 'mine.py'}:Reach")


def test_what_a_users_file_raises_later_names_file_and_line(tmp_path):
  file = tmp_path / "mine.py"
  file.write_text("def late():\n  return [].pop()\n\n\ndef deep():\n  return deep()\n")
  late, deep = (plugins.find(f"{file}:{name}", "fault") for name in ("late", "deep"))
  with (
    pytest.raises(PluginError, match=r"mine.py, line 2: IndexError: pop from empty"),
    app.ours(List()),
  ):
    late()
  with pytest.raises(PluginError, match=r"mine.py, line 6: RecursionError"), app.ours(List()):
    deep()
  with pytest.raises(IndexError), app.ours(List()):  # of this package: a bug
    [].pop()
