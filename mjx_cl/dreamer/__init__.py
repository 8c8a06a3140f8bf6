"""DreamerV3 (Hafner et al. 2025) in pure functions over one seed, which callers vmap; its replay.

Imports config, sizes and below.
"""
