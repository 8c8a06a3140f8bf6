"""`run --quick`: other defaults, which flags override; what it refuses; what it says."""

import json

import pytest

from mjx_cl.cli import app, runs
from mjx_cl.config import CHUNK, RunConfig, quick
from mjx_cl.errors import UserError
from mjx_cl.runs import settings


def asked(*words):
  return app.parse(["run", *words])


def one(run):
  """Settings of its only run: what may be several of a command line is one here."""
  own = {k: getattr(run, k) for k in vars(RunConfig(run.env))}
  several = ("fault", "severity", "agent")
  return own | {k: next(iter(own[k]), None) for k in several}


@pytest.mark.parametrize("robot", quick.QUICK)
def test_quick_is_other_defaults(robot):
  """A whole loop fits: onset after the warm-up, room for the alarm and for the stop rule."""
  run, preset = asked(robot, "--quick"), quick.QUICK[robot]
  assert {name: one(run)[name] for name in preset} == preset
  plain = asked(robot)
  same = set(vars(plain)) - set(preset) - {"quick"}
  assert all(getattr(run, name) == getattr(plain, name) for name in same)
  config = settings.check(RunConfig(**one(run)))
  least = max(run.adapt.least, run.adapt.patience * CHUNK)
  assert run.adapt.warmup < run.onset and run.onset + 700 + least < config.steps
  assert run.first_seed >= 100 and run.first_seed + run.seeds <= 110  # tuning seeds


def test_flags_override_quick():
  own = asked("--quick", "walker", "--seeds", "1", "--adapt.patience", "20", "--steps=9000")
  assert (own.seeds, own.adapt.patience, own.steps, own.adapt.least) == (1, 20, 9000, 1536)
  assert (own.fault, own.target, own.severity) == (("gear",), "right_hip", (0.5,))
  # also with what is the default without --quick
  assert (
    asked("walker", "--quick", "--seeds", "4", "--onset", "5000", "--steps", "25000").onset == 5000
  )
  for robot in ("mine.py:Robot", "brax:ant"):  # what all share
    own = asked(robot, "--quick")
    assert (own.seeds, own.steps, own.onset, own.fault) == (2, 6400, 2000, ("gear",))
  # another fault comes without the target and severity of quick's
  other = asked("car", "--quick", "--fault", "payload")
  assert (other.fault, other.target, other.severity, other.onset) == (("payload",), None, (), 2000)
  other = asked("car", "--quick", "--fault", "offset", "--severity", "0.3")
  assert (other.target, other.severity) == (None, (0.3,))


@pytest.mark.parametrize(
  ("words", "says"),
  [
    (("car_real",), "unknown robot of --quick 'car_real'; choose from: car, quadruped, walker"),
    (("walker", "--steps", "2500"), "no finetuning may end before step 3,536"),
    (("walker", "--onset", "5000"), "no finetuning may end before step 6,536"),
    (("walker", "--adapt.least", "6000"), "no finetuning may end before step 8,000"),
    (("walker", "--seeds", "10"), "--quick is for up to 8 streams; got 10 seeds in 2 arms"),
    (("walker", "--snapshots", "500"), "--quick and --snapshots exclude each other"),
    (("walker", "--stops", "x"), "--quick and --stops exclude each other"),
    (("walker", "--bogus", "1"), "--bogus"),
  ],
)
def test_what_leaves_no_loop_is_refused_in_a_line(words, says):
  with pytest.raises(UserError) as e:
    asked(*words, "--quick")
  assert says in str(e.value) and "\n" not in str(e.value)


def test_without_learners_a_short_run_is_fine():
  assert asked("walker", "--quick", "--arm", "none", "--steps", "2500").steps == 2500


def test_it_says_what_it_is_not_and_runs_what_was_asked(monkeypatch, tmp_path, capsys):
  got = []

  def execute(config, out, *_, **__):
    got.append(config)
    return summary

  summary = {"arms": {"detector": {"updates_mean": 3.0}, "none": {"updates_mean": 0.0}}}
  monkeypatch.setattr(runs.run, "execute", execute)
  argv = ["run", "walker", "--quick", "--json", "--out", str(tmp_path / "x")]
  assert app.main(argv) == 0
  out, err = capsys.readouterr()
  assert json.loads(out) == summary and got[0].onset == 2000 and got[0].seeds == 2
  assert err.count("\n") == 1 and "first look, no result: 2 robots for 6,400 steps" in err
  summary["arms"]["detector"]["updates_mean"] = 0.0  # an arm that could have learnt
  assert app.main(argv) == 0
  assert "note: no stream of arm detector has finetuned" in capsys.readouterr().err


def test_help_says_it_in_a_line(capsys):
  with pytest.raises(SystemExit):
    app.main(["run", "--help"])
  assert "two minutes, for a first look" in " ".join(
    capsys.readouterr().out.replace("│", " ").split()
  )
