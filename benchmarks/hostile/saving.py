"""`mjx-cl` that saves a run every half second: `python -m benchmarks.hostile.saving WORDS`, so that a
short run is cut off between two checkpoints, as a long one is.
"""

import functools
import sys

EVERY_S = 0.5


def main() -> int:
  from mjx_cl.cli import app

  def quick(do):
    def done(command):
      from mjx_cl.runs import run

      run.execute = functools.partial(run.execute, save_every_s=EVERY_S)
      do(command)

    return done

  app.DO |= {kind: quick(do) for kind, do in app.DO.items() if kind.__name__ in ("Run", "Bench")}
  return app.main()


if __name__ == "__main__":
  sys.exit(main())
