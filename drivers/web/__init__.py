"""Pages for a browser, from what a robot says on Zenoh."""
