"""Pictures of committed results."""

import matplotlib

matplotlib.use("Agg")
import numpy as np
import pytest
from matplotlib import pyplot

from benchmarks import pictures
from mjx_cl.io import tables


@pytest.fixture
def drawn(monkeypatch):
  """drawn(name): the figure of that picture, which is not written."""
  monkeypatch.setattr(pictures, "_saved", lambda figure, path: figure)
  yield lambda name: pictures.PICTURES[name](pyplot)
  pyplot.close("all")


def test_the_map_says_what_the_certificates_say(drawn):
  axis = drawn("faults").axes[0]
  column = [t.get_text() for t in axis.get_xticklabels()].index("gear")
  row = [t.get_text() for t in axis.get_yticklabels()].index("walker")
  (shown,) = (t.get_text() for t in axis.texts if t.get_position() == (column, row))
  lost = [
    r["return_lost"] / r["return_nominal"]
    for r in tables.read_rows(pictures.RESULTS / "certificates.parquet")
    if (r["robot"], r["fault"], r["severity"]) == ("walker", "gear", 1.0)
    and r["return_lost"] is not None
  ]
  assert lost and shown == f"{100 * np.mean(lost):.0f}"


def test_the_board_is_drawn_best_on_top_without_dummies(drawn):
  whole, *robots = drawn("leaderboard").axes
  names = [t.get_text() for t in whole.get_yticklabels()]
  overall = tables.read_rows(pictures.RESULTS / "leaderboard_overall.parquet")
  best = max(
    (r for r in overall if r["detector"] not in pictures.DUMMIES), key=lambda r: r["cost_standard"]
  )
  assert names[-1] == best["detector"] and "random" not in names
  assert {axis.get_title() for axis in robots} == {"walker", "quadruped", "car"}
