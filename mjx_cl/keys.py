"""Who draws what from which random key: every fixed number that the package folds into a key.

A key is the root of independent streams of draws. Its users fold a number of their own into it, or
a counter (the control step, the chunk, the index of a fault); two users of one key must never fold
in the same number. There is one enum for each kind of key. Numbers are part of what a seed means:
a changed one changes every published life. `jax.random.split(key, n)` is as if 0 .. n - 1 were
folded in, so a key that is split has no further user below n.
"""

import enum


@enum.unique
class OfSeed(enum.IntEnum):
  """Of `jax.random.key(seed)`, which a stream's beginning splits in three.

  Attributes:
    ADAPTATION: the stream's key of residuals, signals, replay and updates, see `OfAdaptation`.
    SNAPSHOTS: episodes in which saved weights are evaluated.
    FURTHER: this and what follows, the second, third, ... of several streams of one seed.
    WATCH: predictions of a recording; the chunk is folded in after it.
  """

  ADAPTATION = 7
  SNAPSHOTS = 9
  FURTHER = 1_000
  WATCH = 2_000


@enum.unique
class OfStream(enum.IntEnum):
  """Of a robot's own key, into which the control step is folded for everything else.

  The draws below a member are not those below the step of the same number: a step's are `OfStep`,
  these fold in the clock after it.

  Attributes:
    AGAIN: the key of a robot that its user resets a second time in one control step.
    TRAINING_FAULT: target and severity of the fault of a training episode, by the clock.
  """

  AGAIN = 3
  TRAINING_FAULT = 11


@enum.unique
class OfStep(enum.IntEnum):
  """Of a robot's key with the control step folded in.

  Attributes:
    ACT: the agent's latent and action, and noise on a demonstrator's.
    FAULTS: what faults draw on the way to the robot, see `OfFaults`.
    EPISODE: where a new episode begins.
    SHAKE: whether a stretch of steps, folded in by its number, is driven at random, and where to.
    READING: what faults draw at the sensors, in reading the observation arrived at.
    FIRST_READING: the same in reading an episode's first observation.
  """

  ACT = 0
  FAULTS = 1
  EPISODE = 2
  SHAKE = 3
  READING = 4
  FIRST_READING = 5


@enum.unique
class OfFaults(enum.IntEnum):
  """Of a step's key of faults, into which each fault's index is folded.

  Attributes:
    WALK: severities that walk at random.
  """

  WALK = 10_000


@enum.unique
class OfAdaptation(enum.IntEnum):
  """Of a stream's key of adaptation, into which the control step, above 0, is folded per chunk.

  Attributes:
    FRESH: new parameters.
  """

  FRESH = 0


@enum.unique
class OfMonitor(enum.IntEnum):
  """Of the key of a chunk's predictions, which those of n steps draw from as it is.

  Attributes:
    AHEAD: predictions of one step.
  """

  AHEAD = 1_000_000
