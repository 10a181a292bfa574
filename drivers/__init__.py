"""The outside world behind small protocols: cameras, base controller, Zenoh."""
