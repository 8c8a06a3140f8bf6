"""One look for all figures."""

import matplotlib
from matplotlib.colors import to_rgb

from mjx_cl.adapt.arms import ARMS
from mjx_cl.render import style


def test_every_arm_has_a_colour_of_its_own():
  assert set(style.ARMS) == set(ARMS)
  assert len({to_rgb(color) for color in style.ARMS.values()}) == len(ARMS)
  assert style.arm("one of another package") in style.CYCLE


def test_the_look_ends_with_its_block():
  before = dict(matplotlib.rcParams)
  with style.look():
    assert not matplotlib.rcParams["axes.spines.top"]
  assert dict(matplotlib.rcParams) == before
