"""Poor surroundings: a full disk, a folder that cannot be written to, few open files, little memory,
an output that nobody can write to.
"""

from __future__ import annotations

import contextlib
import os
import pathlib
import subprocess
from collections.abc import Iterator

import numpy as np

from benchmarks.hostile import room

COMMANDS = {
  "run": [*room.RUN, "--out", "out/o"],
  "train": ["train", "robot.py:Reach", "--preset", "tiny", "--set", "updates=32", "ratio=4", "--save-every-s", "1",
            "--out", "out/o"],
  "record": ["record", *room.STREAMS_OF, "--out", "out/o"],
  "leaderboard": ["leaderboard", "set", "--detector", "z_score", "--out", "out/o"],
  "export": ["leaderboard", "set", "--export", "out/o"],
  "detect": ["detect", "log.csv", "--nominal", "nominal.csv", "--arl0", "200", "--detector", "z_score", "--out", "out/o"],
  "bench": ["bench", "suite.toml", "--jobs", "1", "--out", "out/o"],
  "render": ["render", "walker", "--agent", "none", "--steps", "8", "--view", "robot", "--out", "out/o.gif"],
  "plot": ["plot", "out/run"],
  "query": ["query", "run", "from runs"],
  "list": ["list", "--json"],
}  # fmt: skip
WRITE = ("run", "train", "record", "leaderboard", "export", "detect", "bench", "render", "plot")
# what an error's line must name, one of them
NAMES = {"full disk": ("space", "cannot write", "disk"), "read only": ("read-only", "cannot write", "cannot make"),
         "files": ("open files", "too many"), "memory": ("memory", "address space", "allocate", "map segment"),
         "file size": ("large", "cannot write", "size", "cannot read"), "output": ("space", "output")}  # fmt: skip
KINDS = ("full disk", "read only", "files", "memory", "file size", "output")


def draw(seed: int, number: int) -> tuple[str, str, np.random.Generator]:
  """(kind, command, generator) of a case."""
  rng = np.random.default_rng((seed, number, 2))
  kind = KINDS[number % len(KINDS)]
  names = list(WRITE) if kind in ("full disk", "read only", "file size") else list(COMMANDS)
  return kind, str(rng.choice(names)), rng


def limits(kind: str, rng: np.random.Generator) -> dict[str, int]:
  """Limits of the process."""
  if kind == "files":
    return {"NOFILE": int(rng.integers(12, 64))}
  if kind == "memory":
    return {"AS": int(2**30 * rng.uniform(0.4, 5.0))}
  if kind == "file size":
    return {"FSIZE": int(2 ** rng.uniform(9, 17))}
  return {}


@contextlib.contextmanager
def disk(kind: str, folder: pathlib.Path, rng: np.random.Generator) -> Iterator[bool]:
  """A small or read-only file system at folder/out, with a finished run in it; False where this user
  may not mount one.
  """
  out = folder / "out"
  out.mkdir()
  if kind not in ("full disk", "read only"):
    subprocess.run(["cp", "-r", folder / "run", out / "run"], check=True)
    yield True
    return
  size = int(2 ** rng.uniform(17, 21))
  if subprocess.run(
    ["mount", "-t", "tmpfs", "-o", f"size={size + 400_000}", "tmpfs", out], capture_output=True
  ).returncode:
    yield False
    return
  try:
    subprocess.run(["cp", "-r", folder / "run", out / "run"], check=True)
    if kind == "full disk":
      left = os.statvfs(out)
      with contextlib.suppress(OSError), open(out / "filler", "wb") as file:
        file.write(bytes(max(0, left.f_bavail * left.f_frsize - int(2 ** rng.uniform(8, 17)))))
    else:
      subprocess.run(["mount", "-o", "remount,ro", out], check=True)
    yield True
  finally:
    subprocess.run(["umount", "-l", out], check=True)
