"""Every reader of bytes from outside, a module for each kind."""
