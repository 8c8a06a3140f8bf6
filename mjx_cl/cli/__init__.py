"""The command line: flags, commands, what is printed.

Imports from every other room.
"""
