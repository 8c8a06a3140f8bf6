"""Files and machines: tables, arrays, checkpoints, folders, JAX set up, memory, plug-ins, signals.

Imports types, errors and keys alone.
"""
