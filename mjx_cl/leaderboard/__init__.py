"""Detectors compared: recorded streams, one rate of false alarms, a board of scores.

Imports from runs and below.
"""
