"""Methods that are told the onset, as arms: what a method gains is not mixed with what the detector
misses. `mjx-cl run walker --arm benchmarks/methods.py:quiet` from the repository's root.
"""

from mjx_cl.adapt.arms import ONSET, RULE, Arm


def staged() -> Arm:
  """World model, then critic, then actor."""
  return Arm("method `staged`, told the onset", ONSET, RULE, method="staged")


def calm() -> Arm:
  """Explores in dreams alone."""
  return Arm("method `calm`, told the onset", ONSET, RULE, method="calm")


def guarded() -> Arm:
  """Old and new weights by turns."""
  return Arm("method `guarded`, told the onset", ONSET, RULE, method="guarded")


def quiet() -> Arm:
  """Acts without exploring from the onset on, and explores in dreams."""
  return Arm("method `quiet`, told the onset", ONSET, RULE, method="quiet")


def still() -> Arm:
  """Acts without exploring from the onset on, and learns nothing."""
  return Arm("method `still`, told the onset", ONSET, RULE, method="still")


def swift() -> Arm:
  """As quiet, but learns from the first records on, follows sooner and ends later."""
  return Arm("method `swift`, told the onset", ONSET, RULE, method="swift")
