"""The commands train and eval: agents made, and what they return."""

import dataclasses
import math
import pathlib
from typing import Any

from mjx_cl import envs
from mjx_cl.cli import track, trainings
from mjx_cl.cli.flags import Eval, Train
from mjx_cl.cli.live import TrainDisplay
from mjx_cl.cli.output import command_line, emit, say
from mjx_cl.config import (
  PRESETS,
  DreamerConfig,
  RunConfig,
  TrainConfig,
  check_seeds,
  field_kinds,
  replace,
  settings,
)
from mjx_cl.errors import FileError, choose, require
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.io import folders
from mjx_cl.runs import run
from mjx_cl.runs.settings import check
from mjx_cl.training import agents, evaluate, files, premises, trainer

MOST_EPISODES = 10_000  # all at once in one program


def do_train(args: Train) -> None:
  """Trains agents."""
  track.check(args.track)
  on = trainings.asked(args)
  dreamer, config = chosen(args)
  env = envs.make(args.env, args.physics)
  # whatever can be refused is refused before an earlier training is touched
  shown = files.shown(config, args.out, args.demonstrator)
  if shown.demonstrator and args.demonstrator != "ppo":
    premises.expert(env, shown.demonstrator)
  premises.faults_of(env, config)
  premises.check(env, dreamer, config, args.agent)
  if on:
    cards = trainings.spread(args, env, dreamer, config, command_line("train"), on)
    if args.json:
      emit(cards)
    return
  card = trained(args, env, dreamer, config, command_line("train"))
  if args.json and card:
    emit(card)


def trained(
  args: Train, env: Any, dreamer: DreamerConfig, config: TrainConfig, command: str
) -> dict[str, Any] | None:
  """Trains in one process; the agent's card, None where that training is finished."""
  state = folders.claim_folder(args.out, args.resume, args.overwrite, done_marker="agent/card.json")
  if state != "new":
    updates = files.check_same(
      args.out, env, dreamer, config, args.seed, args.seeds, args.demonstrator, args.agent
    )
  if state == "done":
    require(
      updates == config.updates,
      f"{args.out}: this training has finished its {updates:,} updates; go on with --agent "
      f"{pathlib.Path(args.out, 'agent')} and another --out",
    )
    say(f"{args.out}: this training is finished")
    return None
  trainer.fits(env, premises.scaled(env, dreamer), config, args.seeds)
  if state == "new" and args.overwrite:
    clear(args, config)
  training = files.build(
    env,
    dreamer,
    config,
    args.out,
    args.seed,
    args.seeds,
    args.demonstrator,
    args.agent,
    args.preset,
    command,
    state == "resume",
  )
  with (
    TrainDisplay(config.updates) as display,
    track.beside(display, track.of_training, args.out, args.track, state == "resume") as show,
  ):
    trainer.run(training, show, args.save_every_s)
  card = files.export(training)
  if not args.json:
    say(
      f"agent in {args.out}/agent, return {card['eval']['return_mean']:.0f} over "
      f"{card['eval']['episodes']} episodes"
    )
  return card


def chosen(args: Train) -> tuple[DreamerConfig, TrainConfig]:
  """Learner and schedule of the preset with the settings of --set.

  Raises:
    UserError: for an unknown preset or setting, or a value out of range.
  """
  preset = choose("preset", args.preset, PRESETS)
  changes: dict[str, Any] = settings(args.set)
  names = {f.name for f in dataclasses.fields(TrainConfig)}
  known = {f.name for f in dataclasses.fields(DreamerConfig)}
  own = {k: v for k, v in changes.items() if k in names}
  rest = {k: v for k, v in changes.items() if k not in names}
  field_kinds("--set", TrainConfig, own)
  config = replace(preset.train, **own)
  for name in rest:
    choose("setting", name, dict.fromkeys(names | known))
  field_kinds("--set", DreamerConfig, rest)
  dreamer = replace(preset.dreamer, **rest)
  require(
    not args.agent or "warmup" not in rest,
    "--set warmup does nothing with --agent, whose optimiser is past it; leave it out, lr acts",
  )
  require(args.seeds >= 1, f"seeds must be above 0; got {args.seeds}")
  check_seeds(args.seed)
  every = args.save_every_s
  require(0 < every < math.inf, f"--save-every-s must be above 0; got {every}")
  return dreamer, config


def clear(args: Train, config: TrainConfig) -> None:
  """Removes an earlier training in --out.

  Raises:
    UserError: where the new one needs something of it.
  """
  out = pathlib.Path(args.out)
  own = [out / name for name in ("agent", "agents", "demonstrator", "checkpoints", "work")]
  for name, given in (
    ("agent", args.agent),
    ("demonstrator", args.demonstrator or config.demonstrator),
  ):
    require(
      not given or not any(pathlib.Path(given).resolve().is_relative_to(x.resolve()) for x in own),
      f"--overwrite removes --{name} {given} with {out}; give another --out",
    )
  run.clear(out)
  files.clear(out)


def do_eval(args: Eval) -> None:
  """Prints what an agent returns."""
  require(
    1 <= args.episodes <= MOST_EPISODES,
    f"episodes must lie in 1..{MOST_EPISODES:,}, which are lived side by side; got {args.episodes}",
  )
  check_seeds(args.seed, args.episodes)
  config = check(
    RunConfig(
      args.env, args.fault, args.target, args.severity, physics=args.physics, agent=args.agent
    )
  )
  env = envs.make(becomes(config) or config.env, args.physics)
  trained = agents.of(env, args.agent)
  result: dict[str, Any] = evaluate.evaluate(
    env,
    trained.agent,
    trained.train.params,
    args.episodes,
    args.seed,
    trained.repeat,
    args.deterministic,
    changes(config),
  )
  mean, interval = result["return_mean"], result["return_ci"]
  if not math.isfinite(mean):
    raise FileError(
      f"agent {trained.path}: its return on {args.env} is {mean}; its weights or the robot give "
      "what is no number"
    )
  broken = {k: getattr(config, k) for k in ("fault", "target", "severity")}
  result = {
    "env": args.env,
    "agent": pathlib.Path(trained.path).name,
    **(broken if config.fault != "none" else {}),
    **result,
  }
  if args.json:
    emit(result)
    return
  who = args.env
  if config.fault != "none":
    who += f" under {config.fault}"
    who += "" if config.severity is None else f" {config.severity:g}"
    drawn = any(c.target is None and c.fault != "none" for c in changes(config))
    who += ", target drawn in each episode" * drawn
  said = f"{who}: return {mean:.1f} in one episode"
  if interval:
    said = (
      f"{who}: return {mean:.1f} (IQM {result['return_iqm']:.1f}, 95 % interval "
      f"{interval[0]:.1f} to {interval[1]:.1f}) over {args.episodes} episodes, "
      f"{result['terminations']} terminations"
    )
  print(said)
  base = ("env", "agent", "severity", "episodes", "return_mean", "return_iqm", "terminations")
  figures = {k: v for k, v in result.items() if isinstance(v, (int, float)) and k not in base}
  if figures:
    print("  " + ", ".join(f"{k} {v:.3g}" for k, v in figures.items()))
