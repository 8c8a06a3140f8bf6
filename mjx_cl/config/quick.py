"""Settings of `mjx-cl run --quick`: a whole loop in about two minutes, for a first look.

Fault, seeds and onset were chosen on seeds 100 to 109 so that the shipped detector gives an alarm
and the finetuning ends, or its end is in sight. Imports config alone, no JAX.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from mjx_cl.config import CHUNK, AdaptConfig, RunConfig
from mjx_cl.errors import choose, require

# the rule needs 24 chunks to settle instead of 94, updates begin after 321 steps instead of 1,088
ADAPT = AdaptConfig(least=1536, patience=16, start_windows=256)
SHARED: dict[str, Any] = {"seeds": 2, "onset": 2000, "steps": 6400, "adapt": ADAPT}
QUICK: dict[str, dict[str, Any]] = {
  "walker": SHARED | {"target": "right_hip", "severity": 0.5, "first_seed": 105},
  "quadruped": SHARED
  | {"fault": "bias", "target": "joint_vel", "severity": 0.5, "first_seed": 105},
  "car": SHARED | {"fault": "friction", "target": "rear", "severity": 0.25, "first_seed": 105},
}
FAULT = ("target", "severity")  # of the preset's own fault alone


def defaults(env: str) -> dict[str, Any]:
  """What RunConfig's defaults are with --quick; of a robot of one's own (`FILE.py:NAME`) or of
  another library those that all share.

  Raises:
    UserError: for another robot without.
  """
  return SHARED if ":" in env else choose("robot of --quick", env, QUICK)


def check(config: RunConfig, listens: bool) -> None:
  """Refuses what leaves nothing of the loop to be seen.

  Args:
    config: of the run.
    listens: an arm of it may finetune.

  Raises:
    UserError: one line.
  """
  for name in ("snapshots", "stops"):
    require(not getattr(config, name), f"--quick and --{name} exclude each other")
  require(
    config.seeds * len(config.arms) <= 8,
    f"--quick is for up to 8 streams; got {config.seeds} seeds in {len(config.arms)} arms",
  )
  own = config.adapt
  least = max(own.least, own.patience * CHUNK)
  last = max(config.onset, own.warmup) + least
  require(
    not listens or last < config.steps,
    f"--quick: no finetuning may end before step {last:,} (onset {config.onset:,}, then "
    f"{least:,} of adapt.least and adapt.patience), and the run has steps={config.steps:,}",
  )


def said(config: RunConfig) -> str:
  """What such a run is not, in a line."""
  plain = {f.name: f.default for f in dataclasses.fields(RunConfig)}
  return (
    f"--quick is a first look, no result: {config.seeds} robots for {config.steps:,} steps, "
    f"{plain['seeds']} for {plain['steps']:,} without it; its stop rule is the looser one of a "
    "short run"
    + ", and its seeds are those that the settings were chosen on"
    * (config.env in QUICK)
  )
