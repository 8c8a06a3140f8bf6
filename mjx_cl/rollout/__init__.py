"""Robots, agents and faults in one scan: acting, residuals of the predictions, transfers.

Imports faults and dreamer, and what lies below them.
"""
