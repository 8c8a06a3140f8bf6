"""Robots, agents and faults in one scan: acting, residuals, transfer to another robot.

Imports from envs, faults, dreamer and below.
"""
