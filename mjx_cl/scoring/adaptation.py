"""Methods of adaptation against each other: how much of the return that a fault takes each wins
back, at what price.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any, NamedTuple

import numpy as np

from mjx_cl.errors import UserError
from mjx_cl.scoring import comparison, intervals, survival

NOTHING, PAPER = "none", "detector"  # arm whose score is 0, and that of the paper's method
TENTH = 0.1  # of the reward before the fault
REPS = 5_000  # bootstrap draws
EXACT = 12  # pairs up to which every choice of signs is counted
KEYS = ("robot", "setting", "method", "agent", "seed")


class Board(NamedTuple):
  """Methods against each other.

  Attributes:
    rows: a dict for each method x setting, see `of_setting`.
    overall: a dict for each method, see `board`, best gain first, without one last; best
      score first where the paper's method is not there.
    critical_difference: mean ranks further apart differ at 5 % (Nemenyi); None for fewer than two
      methods or settings.
    friedman_p: chance of ranks this uneven if all methods were alike.
  """

  rows: list[dict]
  overall: list[dict]
  critical_difference: float | None
  friedman_p: float | None


class Pair(NamedTuple):
  """A life of a method, and that of arm `none` with the same agent and seed."""

  life: dict
  nothing: dict

  @property
  def lost(self) -> float:
    """Share lost."""
    return share_lost(self.life, self.nothing)

  @property
  def lost_none(self) -> float:
    """Share lost by doing nothing."""
    return share_lost(self.nothing, self.nothing)

  @property
  def known(self) -> bool:
    """Whether both are known."""
    return bool(np.isfinite(self.lost) and np.isfinite(self.lost_none))


Pairs = dict[tuple[str, int], Pair]  # by agent and seed


def paired(lives: list[dict]) -> dict[tuple[str, str], dict[str, Pairs]]:
  """(robot, setting) -> method -> its lives beside those of arm `none`, without those of which that
  was not lived.

  The lives of one's own (key `own`) stand beside one's own `none`, where that was lived, since
  another machine lives another life; the others beside the published one, if there is one.

  Raises:
    UserError: two lives of one method, setting, agent and seed, or a setting without `none`.
  """
  none: dict[tuple, dict[bool, dict]] = {}
  held: dict[tuple[str, str], dict[str, Pairs]] = {}
  place = lambda life: (life["robot"], life["setting"])
  unit = lambda life: (life["agent"], life["seed"])
  for life in lives:
    if life["method"] == NOTHING:
      of = none.setdefault((*place(life), *unit(life)), {})
      if bool(life.get("own")) in of:
        raise UserError(f"two lives of {', '.join(str(life[k]) for k in KEYS)}")
      of[bool(life.get("own"))] = life
  for life in lives:
    pairs = held.setdefault(place(life), {}).setdefault(life["method"], {})
    of = none.get((*place(life), *unit(life)), {})
    own = bool(life.get("own"))
    if not of or (life["method"] == NOTHING and own and False in of):
      continue
    if unit(life) in pairs:
      raise UserError(f"two lives of {', '.join(str(life[k]) for k in KEYS)}")
    pairs[unit(life)] = Pair(life, of[own] if own in of else of[not own])
  for (robot, setting), methods in held.items():
    if NOTHING not in methods:
      raise UserError(f"setting {setting} of {robot} has no arm {NOTHING!r} to compare with")
  return held


def share_lost(life: dict, nothing: dict) -> float:
  """Return lost after the onset, of what the reward before the fault would have brought; that
  reward is of arm `none` of the same agent and seed, which no false alarm cuts short. nan where it
  was not above 0, or is not known.
  """
  if None in (life["reward_pre"], life["return_lost"], nothing["reward_pre"]):
    return np.nan
  earned = life["reward_pre"] * life["steps"] - life["return_lost"]
  full = nothing["reward_pre"] * life["steps"]
  return 1 - earned / full if full > 0 else np.nan


def board(lives: list[dict]) -> Board:
  """Scores of every method.

    lost = return lost after the onset / (reward before x steps after)
    score of a setting = 100 (1 - mean lost / mean lost of arm `none`), over the same agents and
      seeds: 0 does nothing, 100 has the reward of before the fault at once, below 0 is worse than
      nothing
    score of a robot = mean over its settings;  score = mean over robots

  Intervals are 95 %: a bootstrap of agents and then of their seeds, drawn with all settings of a
  robot and for all methods alike, nowhere narrower than that of the seeds alone, since few agents
  differ by chance less than agents do. Seeds that arm `none` lacks do not count.

  Args:
    lives: dicts with KEYS, reward_pre, return_lost, return_lost_healthy, onset, steps (from there
      on), affected, recovery_step, terminations, false_alarms, updates, wall_s, as in
      runs.parquet; of arm `none` each setting must have some.

  Returns:
    Board. Rows of `overall`: method, score, score_ci (None where it lacks a robot), and for each
    robot score_ROBOT,
    score_ROBOT_ci; gain, gain_ci, gain_ROBOT, gain_ROBOT_ci: its score less that of the paper's
    method, over the settings, agents and seeds of both; settings; harm: settings in which it loses
    more than `none`, by the paired interval; harm_holm: the same by a sign-flip test at 5 %, lives
    taken as independent, after Holm's correction; harm_agents: of the `pairs` of a setting and an
    agent those of which it is told by the interval of the agent's seeds; harm_streams: share of
    streams that lose more than `none` of the same seed by a tenth of the reward before; falls: in
    the whole life, beyond `none`; updates, wall_s: a stream; false_alarms: share of streams with
    one before the onset; healthy_lost: reward lost before the onset beyond `none` [share];
    mean_rank: over the settings that all have, by the scores over the agents and seeds that all
    have there.

  Raises:
    UserError: as `paired`.
  Reference: Agarwal et al. 2021, NeurIPS 34 (score normalised by two references, bootstrap over
  runs); Holm 1979, Scandinavian Journal of Statistics 6, 65-70; Demsar 2006, Journal of Machine
  Learning Research 7, 1-30.
  """
  held = paired(lives)
  names = list(dict.fromkeys(life["method"] for life in lives))
  robots = dict.fromkeys(robot for robot, _ in held)
  drawn = {robot: _Draws(held, robot, seed) for seed, robot in enumerate(robots)}
  rows = [
    {"robot": robot, "setting": setting, "method": name} | of_setting(own[name])
    for (robot, setting), own in held.items()
    for name in names
    if name in own
  ]
  for row in rows:
    draws = drawn[row["robot"]]
    row["score_ci"] = ends(draws.scores([row["setting"]], row["method"]), row["known"])
    row["beyond_ci"] = ends(draws.beyond(row["setting"], row["method"]), row["known"])
  overall = [_overall(name, rows, held, drawn) for name in names]
  rivals = [name for name in names if name != NOTHING]
  full = []
  for own in held.values():
    known = [{u for u, pair in own.get(name, {}).items() if pair.known} for name in rivals]
    alike = set.intersection(*known) if known else set()
    scores = [of_setting({u: own[name][u] for u in alike})["score"] for name in rivals if alike]
    if scores and None not in scores:
      full.append(scores)
  ranks, critical, p = comparison.ranked(np.array(full, float).reshape(len(full), len(rivals)))
  place = dict(zip(rivals, ranks))
  for row in overall:
    row["mean_rank"] = intervals.finite(place.get(row["method"]))
  # gains are of the same lives, scores of all that a method has
  by = "gain" if any(r["gain"] is not None for r in overall) else "score"
  worth = lambda r: 0.0 if by == "gain" and r["method"] == PAPER else r[by]
  overall.sort(key=lambda r: -np.inf if worth(r) is None else worth(r), reverse=True)
  return Board(rows, overall, critical, p)


def of_setting(pairs: Pairs) -> dict[str, Any]:
  """What one method does in one setting, beside `none`.

  Returns:
    streams: pairs; known: those of which both losses are known; agents; score; lost, lost_none:
    mean shares; beyond: mean of the pairs'
    differences in lost, beyond_p (sign flips); harmed: agents that by themselves lose more than
    `none`, by the interval of their seeds; worse: pairs that lose more than `none` by a tenth;
    affected: those of which recovery is known; recovered: of these; recovery_steps: mean time to
    recovery up to the longest that could be seen, those that take longer counted as that, with
    recovery_steps_ci; falls, false_alarms, healthy_lost, updates, wall_s: as `board`.
  """
  two = [pairs[unit] for unit in sorted(pairs)]
  lost, none = np.array([(p.lost, p.lost_none) for p in two]).reshape(-1, 2).T
  beyond = lost - none
  agents = [agent for agent, _ in sorted(pairs)]
  apart = [beyond[[whose == agent for whose in agents]] for agent in dict.fromkeys(agents)]
  known = np.isfinite(beyond)
  lost, none, beyond = lost[known], none[known], beyond[known]
  mean = lambda x: float(np.mean(x)) if len(x) else None
  # a run tells recovery by its own arm `none`, and only of streams that lose a tenth there
  hit = [p.life for p in two if p.nothing["affected"] and p.life["affected"]]
  score = None if not len(none) or none.mean() <= 0 else 100 * (1 - lost.mean() / none.mean())
  before = lambda life: (life["reward_pre"] or 0.0) * life["onset"]
  return {
    "streams": len(two),
    "known": len(beyond),
    "agents": len(apart),
    "score": intervals.finite(score),
    "lost": mean(lost),
    "lost_none": mean(none),
    "beyond": mean(beyond),
    "beyond_p": sign_flips(beyond),
    "harmed": sum(_above_0(x[np.isfinite(x)]) for x in apart),
    "worse": int(np.sum(beyond > TENTH)),
    "affected": len(hit),
    "recovered": sum(life["recovery_step"] is not None for life in hit),
    **_time(hit),
    "falls": mean([a["terminations"] - b["terminations"] for a, b in two]),
    "false_alarms": sum(p.life["false_alarms"] > 0 for p in two),
    "healthy_lost": mean(
      [
        (a["return_lost_healthy"] - b["return_lost_healthy"]) / before(b)
        for a, b in two
        if None not in (a["return_lost_healthy"], b["return_lost_healthy"]) and before(b) > 0
      ]
    ),
    "updates": mean([p.life["updates"] for p in two]),
    "wall_s": mean([p.life["wall_s"] for p in two if p.life["wall_s"] is not None]),
  }


def _above_0(x: np.ndarray) -> bool:
  """Whether a mean is above 0, by its interval."""
  ends = intervals.interval(x, np.mean)
  return ends is not None and ends[0] > 0


def _time(hit: list[dict]) -> dict[str, Any]:
  """Restricted mean time to recovery of affected streams, and its interval; None where a life is
  too short to show one.
  """
  if not hit or min(life["steps"] for life in hit) <= survival.recovery.HOLD:
    return {"recovery_steps": None, "recovery_steps_ci": None}
  seen = np.array([life["recovery_step"] is not None for life in hit])
  last = min(life["steps"] for life in hit) - survival.recovery.HOLD
  time = np.array(
    [
      last if r is None else min(last, r - life["onset"])
      for life in hit
      for r in [life["recovery_step"]]
    ],
    float,
  )
  mean, ends = survival.restricted_mean(time, seen, last)
  return {"recovery_steps": mean, "recovery_steps_ci": ends}


def sign_flips(x: np.ndarray) -> float | None:
  """Two-sided chance of a mean as far from 0 if each value's sign were a coin's: over all choices
  of signs up to EXACT values, else over 20,000. None for fewer than two.
  """
  if len(x) < 2:
    return None
  if len(x) <= EXACT:
    signs = np.array(list(itertools.product((-1, 1), repeat=len(x))))
  else:
    signs = np.random.default_rng(0).choice((-1, 1), (20_000, len(x)))
    signs[0] = 1  # what was seen is one of them
  means = np.abs(signs @ x)
  return float(np.mean(means >= abs(x.sum()) * (1 - 1e-12)))


def holm(p: list[float | None], level: float = 0.05) -> list[bool]:
  """Which hypotheses Holm's procedure rejects; None is never rejected, and not counted."""
  known = sorted((value, i) for i, value in enumerate(p) if value is not None)
  out = [False] * len(p)
  for k, (value, i) in enumerate(known):
    if value > level / (len(known) - k):
      break
    out[i] = True
  return out


class _Draws:
  """Bootstrap of one robot's agents and seeds.

  Attributes:
    units: (agent, seed) of arm `none` in any of the robot's settings.
    counts: how often each draw holds each unit, (2, REPS, units): agents and then seeds, and seeds
      alone; of one agent the two are alike.
  """

  def __init__(self, held: dict, robot: str, seed: int) -> None:
    self.settings = {setting: own for (whose, setting), own in held.items() if whose == robot}
    self.units = sorted({u for own in self.settings.values() for u in own[NOTHING]})
    groups: dict[str, list[int]] = {}
    for k, (agent, _) in enumerate(self.units):
      groups.setdefault(agent, []).append(k)
    random, n = np.random.default_rng(seed), len(self.units)
    drawn = random.integers(0, n, (REPS, n))
    flat = np.stack([np.bincount(row, minlength=n) for row in drawn])
    nested = flat
    if len(groups) > 1:
      own, nested = list(groups.values()), np.zeros_like(flat)
      for row, agents in zip(nested, random.integers(0, len(own), (REPS, len(own)))):
        for a in agents:
          np.add.at(row, np.array(own[a])[random.integers(0, len(own[a]), len(own[a]))], 1)
    self.counts = np.stack([nested, flat])

  @functools.cached_property
  def _lost(self) -> dict[tuple[str, str], np.ndarray]:
    """(setting, method) -> shares lost by it and by doing nothing of each unit, (2, units), nan
    where either is not known.
    """
    nowhere = (np.nan, np.nan)
    return {
      (setting, name): np.array(
        [(of[u].lost, of[u].lost_none) if u in of and of[u].known else nowhere for u in self.units]
      ).T
      for setting, own in self.settings.items()
      for name, of in own.items()
    }

  def scores(self, settings: list[str], method: str) -> np.ndarray:
    """Mean score over settings in every draw, (2, REPS)."""
    return self._share(settings, NOTHING, method)

  def gains(self, settings: list[str], method: str) -> np.ndarray:
    """Mean over settings of the score less that of the paper's method in every draw, (2, REPS)."""
    return self._share(settings, PAPER, method)

  def _share(self, settings: list[str], first: str, second: str) -> np.ndarray:
    """Mean over settings of the score of `second` less that of `first` in every draw, of the units
    of both; nan where a draw holds no such unit, inf of the sign of what `second` spares where
    nothing is lost by doing nothing.
    """
    out = []
    for setting in settings:
      both = np.stack([self._lost[setting, name] for name in (first, second)])
      known = np.isfinite(both).all((0, 1))
      held = self.counts[..., known]
      (one, one_none), (other, other_none) = ([held @ x for x in lost] for lost in both[..., known])
      spared = (one - one_none) - (other - other_none)
      with np.errstate(divide="ignore", invalid="ignore"):
        score = 100 * (one / one_none - other / other_none)
        open_end = np.where(spared == 0, 0.0, np.sign(spared) * np.inf)
      score = np.where((one_none > 0) & (other_none > 0), score, open_end)
      out.append(np.where(held.any(-1), score, np.nan))
    with np.errstate(invalid="ignore"):  # inf less inf
      return np.mean(out, 0)

  def beyond(self, setting: str, method: str) -> np.ndarray:
    """Mean of what is lost beyond `none` in every draw, (2, REPS)."""
    x = np.subtract(*self._lost[setting, method])
    known = np.isfinite(x)
    held = self.counts[..., known]
    with np.errstate(divide="ignore", invalid="ignore"):
      return held @ x[known] / held.sum(-1)


def ends(drawn: np.ndarray, pairs: int) -> list[float | None] | None:
  """Interval of what was drawn of so many pairs, (2, REPS): the ends of the wider of both
  bootstraps, without draws of agents that have no such pair or in which one setting is infinitely
  well and another infinitely badly off; None of fewer than two pairs.
  """
  drawn = drawn[:, ~np.isnan(drawn).any(0)]
  found = intervals.ends(drawn) if pairs > 1 and drawn.size else [None, None]
  if found[0] is None or found[1] is None:
    return None
  low, high = zip(*found)
  return [None if None in pair else pick(pair) for pick, pair in ((min, low), (max, high))]


def _overall(name: str, rows: list[dict], held: dict, drawn: dict[str, _Draws]) -> dict[str, Any]:
  """A row of `overall`."""
  own = [r for r in rows if r["method"] == name]
  robots = {
    robot: [r for r in own if r["robot"] == robot and r["score"] is not None]
    for robot in dict.fromkeys(r["robot"] for r in own)
  }
  robots = {robot: of for robot, of in robots.items() if of}

  def a_life(key: str) -> float | None:
    known = [r for r in own if r[key] is not None]
    of = [np.array([r[k] for r in known], float) for k in (key, "streams")]
    return float(np.average(of[0], weights=of[1])) if known else None

  out: dict[str, Any] = {"method": name}
  each = {robot: float(np.mean([r["score"] for r in of])) for robot, of in robots.items()}
  # of fewer robots than the board has no mean compares
  whole = set(each) == {robot for robot, _ in held}
  out["score"] = float(np.mean(list(each.values()))) if whole else None
  sampled = {r: drawn[r].scores([x["setting"] for x in of], name) for r, of in robots.items()}
  fewest = lambda of: min((r["known"] for r in of), default=0)
  scored = [r for of in robots.values() for r in of]
  out["score_ci"] = _ends(list(sampled.values()), fewest(scored)) if whole else None
  for robot, of in robots.items():
    out |= {
      f"score_{robot}": each[robot],
      f"score_{robot}_ci": _ends([sampled[robot]], fewest(of)),
    }
  out |= _gain(name, robots, held, drawn)
  streams = sum(r["streams"] for r in own)
  hurt = holm([r["beyond_p"] for r in own])
  return out | {
    "settings": len(own),
    "streams": streams,
    "agents": max((r["agents"] for r in own), default=0),
    "harm": sum(r["beyond_ci"] is not None and (r["beyond_ci"][0] or 0) > 0 for r in own),
    "harm_agents": sum(r["harmed"] for r in own),
    "pairs": sum(r["agents"] for r in own),
    "harm_holm": sum(h and r["beyond"] > 0 for h, r in zip(hurt, own)),
    "harm_streams": sum(r["worse"] for r in own) / streams if streams else None,
    "recovered": sum(r["recovered"] for r in own),
    "affected": sum(r["affected"] for r in own),
    "falls": a_life("falls"),
    "false_alarms": sum(r["false_alarms"] for r in own) / streams if streams else None,
    "healthy_lost": a_life("healthy_lost"),
    "updates": a_life("updates"),
    "wall_s": a_life("wall_s"),
  }


def _ends(of: list[np.ndarray], pairs: int) -> list[float | None] | None:
  """`ends` of a mean over robots."""
  with np.errstate(invalid="ignore"):  # inf less inf
    return ends(np.mean(of, 0), pairs) if of else None


def _gain(name: str, robots: dict, held: dict, drawn: dict[str, _Draws]) -> dict:
  """Score less that of the paper's method, over the settings and units of both: gain, gain_ci, of
  all robots and of each.
  """
  out: dict[str, Any] = {"gain": None, "gain_ci": None}
  if name == PAPER:
    return out
  means, sampled, fewest = [], [], []
  for robot, of in robots.items():
    scores, settings, pairs = [], [], []
    for row in of:
      own = held[robot, row["setting"]]
      known = [{u for u, pair in own.get(m, {}).items() if pair.known} for m in (name, PAPER)]
      both = set.intersection(*known)
      two: list[Any] = [
        of_setting({u: own[m][u] for u in both})["score"] if both else None for m in (name, PAPER)
      ]
      if None not in two:
        scores.append(two[0] - two[1])
        settings.append(row["setting"])
        pairs.append(len(both))
    if settings:
      fewest.append(min(pairs))
      means.append(float(np.mean(scores)))
      sampled.append(drawn[robot].gains(settings, name))
      own_ends = _ends(sampled[-1:], fewest[-1])
      out |= {f"gain_{robot}": means[-1], f"gain_{robot}_ci": own_ends}
  if means:
    out |= {"gain": float(np.mean(means)), "gain_ci": _ends(sampled, min(fewest))}
  return out
