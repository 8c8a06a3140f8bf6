"""Agents: training them, demonstrators, evaluation, and those that ship.

Imports from scoring and below.
"""
