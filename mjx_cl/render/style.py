"""How figures look: one style for all, one colour an arm wherever it is drawn.

Colours are those of Okabe and Ito (2008, https://jfly.uni-koeln.de/color/), which colour-blind
readers tell apart, and darker ones of the same hues.
"""

import contextlib
import zlib
from collections.abc import Iterator
from typing import Any

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8a8a8a"
# by order of their part in the story: the method, doing nothing, being told
ARMS = {
  "detector": BLUE,
  "none": GREY,
  "oracle": GREEN,
  "rollback": "#CC79A7",
  "guarded": "#4b0055",
  "staged": "#a6761d",
  "calm": "#1b9e9e",
  "quiet": "#e7298a",
  "swift": "#6b8e23",
  "quiet-guarded": "#8c1c5a",
  "swift-guarded": "#33470f",
  "ratchet": "#2f4b7c",
  "swift-ratchet": "#00b4a0",
  "still": "#c9a9bb",
  "always": ORANGE,
  "world-model": "#E69F00",
  "scratch": "#7b4f2c",
  "periodic": "#56B4E9",
  "random": "#b3a100",
  "oracle-budget": "#00543d",
  "oracle-stop": "#5fc7a4",
  "randomised": "#6a51a3",
  "no-fault": "#003f63",
}
CYCLE = (BLUE, ORANGE, GREEN, "#CC79A7", "#E69F00", "#56B4E9", "#7b4f2c", "#6a51a3")
STYLE: dict[Any, Any] = {
  "axes.spines.top": False,
  "axes.spines.right": False,
  "axes.titlesize": 10,
  "axes.titlelocation": "left",
  "axes.labelsize": 9,
  "xtick.labelsize": 8,
  "ytick.labelsize": 8,
  "legend.fontsize": 8,
  "legend.frameon": False,
  "font.size": 9,
}


def arm(name: str) -> str:
  """Colour of an arm; one that the table lacks has one of the cycle's, always the same."""
  return ARMS.get(name) or CYCLE[zlib.crc32(name.encode()) % len(CYCLE)]


def nth(k: int) -> str:
  """Colour of the k-th of things that are no arms."""
  return CYCLE[k % len(CYCLE)]


@contextlib.contextmanager
def look() -> Iterator[None]:
  """The style, for what is drawn within."""
  import matplotlib
  from cycler import cycler

  with matplotlib.rc_context(STYLE | {"axes.prop_cycle": cycler(color=CYCLE)}):
    yield
