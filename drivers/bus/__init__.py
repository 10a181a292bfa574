"""Zenoh: messages, requests, sessions."""
