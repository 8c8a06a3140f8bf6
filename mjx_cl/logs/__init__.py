"""Logs of one's own as CSV files: reading them and watching them.

Imports from runs and below.
"""
