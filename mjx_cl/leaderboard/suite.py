"""What is recorded and how it is scored: suites, by name or from a TOML file."""

import dataclasses
import pathlib
from typing import Any

import numpy as np

from mjx_cl.errors import UserError
from mjx_cl.io import tables

SUITES = pathlib.Path(__file__).parent / "suites"
TABLES = {
  "seeds": {"score", "tune"},
  "nominal": {"steps", "score", "tune"},
  "latents": {"nominal", "after_s"},
}
LIMIT = 2**31  # files hold steps, seeds and streams in 31 bits


@dataclasses.dataclass(frozen=True)
class Suite:
  """What is recorded and how it is scored; read from TOML.

  Attributes:
    name: as in suites/leaderboard.toml, and so are the next four.
    arl0: [control steps].
    count_from: [control steps].
    onset: (low, high) [control steps].
    horizon_s: [s].
    seeds: split -> (first, last).
    nominal: steps, and split -> streams per seed.
    latents: nominal (streams), after_s.
    robots: robot -> split -> {fault or fault:target: severities}.
    innovations: whether the signed one-step error of every variable is kept.
  """

  name: str
  arl0: float
  count_from: int
  onset: tuple[int, int]
  horizon_s: float
  seeds: dict[str, tuple[int, int]]
  nominal: dict[str, int]
  latents: dict[str, float]
  robots: dict[str, dict[str, dict[str, tuple[float, ...]]]]
  innovations: bool = False

  def __post_init__(self) -> None:
    whole: dict[str, list[Any]] = {
      "count_from": [self.count_from],
      "onset": list(self.onset),
      **{f"[seeds] {k}": list(v) for k, v in self.seeds.items()},
      **{f"[nominal] {k}": [v] for k, v in self.nominal.items()},
      "[latents] nominal": [self.latents.get("nominal", 0)],
    }
    for name, values in whole.items():
      self._need(
        all(type(v) is int and v < LIMIT for v in values),
        f"{name} must be made of whole numbers below {LIMIT:,}; got {', '.join(map(str, values))}",
      )
    self._need(isinstance(self.name, str), "name must be text")
    self._need(all(len(v) == 2 for v in self.seeds.values()), "[seeds] are [first, last]")
    self._need(
      len(self.onset) == 2 and 0 <= self.count_from <= self.onset[0] < self.onset[1],
      "onset must be [low, high] with count_from <= low < high",
    )
    for name, keys in TABLES.items():
      self._need(set(getattr(self, name)) == keys, f"[{name}] needs {', '.join(sorted(keys))}")
    self._need(isinstance(self.innovations, bool), "innovations must be true or false")
    after_s = self.latents["after_s"]
    for name, value in (("arl0", self.arl0), ("horizon_s", self.horizon_s), ("after_s", after_s)):
      self._need(
        type(value) in (int, float) and 0 <= value < LIMIT,
        f"{name} must be a number from 0 to {LIMIT:,}; got {value!r}",
      )
    self._need(self.arl0 > 0 and self.horizon_s > 0, "arl0 and horizon_s must be above 0")
    self._need(self.latents["nominal"] >= 0, "[latents] nominal must be 0 or above")
    self._need(self.nominal["steps"] > self.count_from, "nominal steps must exceed count_from")
    self._need(
      min(self.nominal["score"], self.nominal["tune"]) >= 1,
      "[nominal] needs one or more streams per seed of either split",
    )
    (a, b), (c, d) = (self.seeds[s] for s in ("score", "tune"))
    self._need(
      min(a, c) >= 0 and a <= b and c <= d and (b < c or d < a),
      "the seeds that score and the seeds that tune must be two ranges without a common seed",
    )
    self._need(self.robots, "no [robots.NAME]")
    for robot, splits in self.robots.items():
      self._check(f"robot {robot!r}", splits)

  def _need(self, holds: object, text: str) -> None:
    if not holds:
      raise UserError(f"suite {self.name!r}: {text}")

  def _check(self, robot: str, splits: dict[str, dict[str, tuple[float, ...]]]) -> None:
    """Refuses faults of a robot that cannot be scored."""
    self._need(
      set(splits) <= {"score", "tune"} and splits.get("score"),
      f"{robot} needs a table `score`, and may have `tune`",
    )
    score, tune = ({k.split(":")[0] for k in splits.get(s, {})} for s in ("score", "tune"))
    self._need(
      not score & tune,
      f"{robot}: {', '.join(sorted(score & tune))} is to tune and to score; take different faults",
    )
    for key, severities in ((k, v) for s in splits.values() for k, v in s.items()):
      sound = all(type(x) in (int, float) and 0 < x <= 1 for x in severities)
      self._need(severities and sound, f"{robot}, {key}: severities in (0, 1]")
    for table in splits.values():
      named = [f"{key.split(':')[0]} {float(x):g}" for key, own in table.items() for x in own]
      twice = sorted({one for one in named if named.count(one) > 1})
      self._need(
        not twice,
        f"{robot}: {', '.join(twice)} is there twice; a line of the board is one fault at one "
        "severity, with one target",
      )

  def numbers(self, split: str) -> list[int]:
    """Seeds of a split."""
    first, last = self.seeds[split]
    return list(range(first, last + 1))

  def onset_of(self, seed: int) -> int:
    """First faulty control step of a seed's streams."""
    return int(np.random.default_rng([seed, 7]).integers(*self.onset))

  def after(self, control_s: float) -> int:
    """Control steps that are kept from the onset on."""
    return int(np.ceil(self.horizon_s / control_s)) + 1


def of(data: dict) -> Suite:
  """A suite from TOML or JSON, which know no tuples."""
  return Suite(
    **data
    | {"onset": tuple(data["onset"]), "seeds": {k: tuple(v) for k, v in data["seeds"].items()}}
  )


def suite(name: str) -> Suite:
  """A suite by name (`mjx-cl list suites`) or from a TOML file. `base` in a file names a suite that
  ships: what the file leaves out is as there.

  Raises:
    UserError for an unknown name or a value out of range; FileError for a file that is no TOML.
  """
  path, data = tables.read_suite(name, SUITES)
  if "base" in data:
    base = data.pop("base")
    names = sorted(p.stem for p in SUITES.glob("*.toml"))
    if base not in names:
      raise UserError(f"suite {path.name}: unknown base {base!r}; choose from: {', '.join(names)}")
    data = tables.read_suite(base, SUITES)[1] | data
  fields = {f.name for f in dataclasses.fields(Suite)}
  wrong = [f"unknown {k!r}" for k in sorted(set(data) - fields)]
  wrong += [f"missing {k!r}" for k in sorted(fields - set(data) - {"innovations"})]
  if wrong:
    raise UserError(f"suite {path.name}: {', '.join(wrong)}; it takes: {', '.join(sorted(fields))}")
  try:
    return of(data)
  except UserError as e:
    raise UserError(f"{path.name}: {e}") from None
  except (TypeError, AttributeError, ValueError) as e:
    raise UserError(f"suite {path.name}: a value of the wrong kind ({e})") from None


def about() -> dict[str, str]:
  """Name -> what a shipped suite holds, in one line."""
  number = lambda table: sum(map(len, table.values()))
  faults = lambda t: (
    f"{number(t['score'])} faults that score, {number(t.get('tune', {}))} that tune"
  )
  suites = [suite(path.stem) for path in sorted(SUITES.glob("*.toml"))]
  return {s.name: ", ".join(f"{r}: {faults(t)}" for r, t in s.robots.items()) for s in suites}
