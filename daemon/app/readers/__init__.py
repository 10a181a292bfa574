"""Programs beside the daemon that read it on Zenoh."""
