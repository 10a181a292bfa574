"""The daemon for hours, with faults on a schedule."""
