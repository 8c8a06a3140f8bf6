"""mjx_cl: a vectorised benchmark for robots that notice a fault, adapt to it and know when they are
done.
"""

__version__ = "0.1.0"
