"""Files and machines: tables, arrays, checkpoints, folders, JAX's start, memory, plug-ins,
interrupts.
"""
