"""Radio modules that measure distances: their wires, and a topic on Zenoh."""
