"""What memory a recording takes at most, known before it begins."""

from mjx_cl.config import CHUNK, DreamerConfig
from mjx_cl.errors import require
from mjx_cl.io import memory
from mjx_cl.leaderboard.streams import COLUMNS, PROJECTION
from mjx_cl.leaderboard.suite import Suite
from mjx_cl.runs.room import LIFE
from mjx_cl.training import needs
from mjx_cl.types import Spec

ROW = (
  4 * len(COLUMNS) + 2 * len(PROJECTION) + 3
)  # bytes of a lane and control step, as `live` gives, without innovations
COPIES = 4  # of them: as lived, rounded, as one table, and that once more while it is written


def of(suite: Suite, robot: str, spec: Spec, learner: DreamerConfig) -> int:
  """Bytes that a process grows to which records a robot of the suite."""
  rows, most = 0, 0
  end = suite.onset[1] - 1 + suite.after(spec.control_s)
  for split, (first, last) in suite.seeds.items():
    faulty = 1 + sum(map(len, suite.robots[robot]["score"].values()))
    if split == "tune":
      faulty += sum(map(len, suite.robots[robot].get("tune", {}).values()))
    healthy, seeds = suite.nominal[split], last - first + 1
    rows += seeds * (healthy * suite.nominal["steps"] + faulty * end)
    most = max(most, seeds * max(healthy, faulty))
  return grown(most, rows, spec, learner, suite.innovations)


def grown(
  lanes: int, rows: int, spec: Spec, learner: DreamerConfig, innovations: bool = False
) -> int:
  """Bytes that a process grows to.

  Args:
    lanes: most robots side by side.
    rows: control steps of all robots.
    spec: of the robot.
    learner: of its agent.
    innovations: whether they are kept.
  """
  row = ROW + 4 * (len(spec.obs) + 1) * innovations
  record = needs.need(learner.size, len(spec.obs), len(spec.act), 0, learner.bins).record
  return memory.resident(lanes * (LIFE + 2 * CHUNK * record)) + COPIES * row * rows


def check(suite: Suite, robot: str, spec: Spec, learner: DreamerConfig) -> None:
  """Refuses a recording that would not fit."""
  need = of(suite, robot, spec, learner)
  space = int(memory.MARGIN * memory.free()) + memory.held()
  require(
    need <= space,
    f"suite {suite.name!r}: streams of {robot} need {need / 2**30:,.1f} GiB, "
    f"{space / 2**30:.1f} GiB may be used; fewer seeds, nominal streams or steps, or an earlier "
    "onset or horizon would fit",
  )
