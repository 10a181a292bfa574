"""The computer and its systemd."""
