"""The process: threads, outputs, requests, the screen."""
