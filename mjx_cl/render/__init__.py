"""Pictures: robots at work as films, and the figures of a run.

Imports from training and below.
"""
