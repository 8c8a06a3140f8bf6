"""Alarm, finetuning, stop: the phase machine (`phase.py`), its convergence test (`convergence.py`),
and the step that joins monitor, detector, phase, replay and updates (`loop.py`), and what is
compared (`arms.py`).
"""
