"""Phases of a stream."""

NOMINAL, ADAPTING, CONVERGED, ABORTED, ENDED = range(5)
PHASES = ("nominal", "adapting", "converged", "aborted", "ended")
