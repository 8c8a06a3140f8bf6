"""DreamerV3's size table: deter = 8 hidden, units = hidden, classes = hidden / 16; layer counts
never change.
"""

from typing import NamedTuple


class Size(NamedTuple):
  """Widths of one preset.

  Attributes:
    deter: deterministic part of the latent.
    hidden: of the layers between.
    classes: of a categorical variable.
    units: of encoder, decoder and heads.
    stoch: number of categorical variables.
    blocks: of the recurrent core.
  """

  deter: int
  hidden: int
  classes: int
  units: int
  stoch: int = 32
  blocks: int = 8


# trainable parameters on walker (24 observations, 6 actions), without the slow critic: 368,659 for
# size400k, 640,867 for size1m, 2,477,219 for size2m, 9,738,019 for size12m
SIZES = {
  "tiny": Size(128, 32, 8, 32, stoch=8),  # not of the table: for tests and probe environments
  # by the table's rule but not of it, like size2m
  "size400k": Size(384, 48, 3, 48),
  "size1m": Size(512, 64, 4, 64),
  "size2m": Size(1024, 128, 8, 128),
  "size12m": Size(2048, 256, 16, 256),
  "size25m": Size(3072, 384, 24, 384),
  "size50m": Size(4096, 512, 32, 512),
  "size100m": Size(6144, 768, 48, 768),
  "size200m": Size(8192, 1024, 64, 1024),
  "size400m": Size(12288, 1536, 96, 1536),
}
