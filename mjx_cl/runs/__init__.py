"""Runs of the whole loop and suites of them, with what they write down.

Imports from render and below.
"""
