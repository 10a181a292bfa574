"""The daemon on one core that others keep busy, with cameras that are too fast for it or too slow."""
