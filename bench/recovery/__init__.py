"""Filters that find a lost pose on a map of points by themselves, for the paper's and the recorded robots' experiments.

Their landmarks have labels or ranges and there is no ceiling, so the daemon's belief over places has nothing to go by.
"""
