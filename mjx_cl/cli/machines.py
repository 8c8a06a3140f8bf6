"""Where the parts of a command run: flags of the commands that a cluster serves. Free of JAX."""

from dataclasses import dataclass
from typing import Literal

WORKER = "mjx_cl.cli.worker"  # what a part's process runs


@dataclass(frozen=True, kw_only=True)
class Machines:
  """Where the parts of a command run.

  Attributes:
    on: here, or ray: on the machines of a Ray cluster, a core a part.
    address: Of the cluster; default: one is started on this machine.
  """

  on: Literal["here", "ray"] = "here"
  address: str | None = None


@dataclass(frozen=True, kw_only=True)
class GpuMachines(Machines):
  """Where parts run that a GPU may serve.

  Attributes:
    gpu: On ray: a GPU of its machine for each part, besides its core.
  """

  gpu: bool = False
