"""Alarm, finetuning, stop: watch, decide, learn and act, joined in loop; arms are what is compared.

Imports from detectors, rollout and below.
"""
