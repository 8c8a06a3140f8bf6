"""From tables to numbers, alarms, recovery, survival, intervals, worth of the stop rule.

Imports from adapt and below.
"""
