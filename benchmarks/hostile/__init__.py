"""A campaign against the command line: bad input, kills, poor surroundings and foreign code, each
case drawn from a seed and its number. `python -m benchmarks.hostile --help`.
"""
