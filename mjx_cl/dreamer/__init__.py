"""DreamerV3 (Hafner et al. 2025) for vector observations and continuous actions: pure functions
over one seed; callers vmap.
"""
