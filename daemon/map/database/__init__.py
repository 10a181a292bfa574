"""The map in SQLite: saved by difference, verified when it is opened, with a good copy and an undo log beside it."""
