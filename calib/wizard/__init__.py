"""Commissioning step by step in a browser: the process that `ceilvod web` starts beside itself, the code of `calib`."""
