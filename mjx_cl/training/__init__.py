"""Agents: training them, demonstrators, evaluation, and those that ship."""
