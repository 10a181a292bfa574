"""Commissioning tool.

Its rooms, each importing only those before it: targets (what is looked at), solve (the mathematics), evaluate (is it
good?), practice (a virtual bench), session (what is kept), commands (a file a step), cli; study measures the whole.
"""
