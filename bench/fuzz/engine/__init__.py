"""One input and what it may do; inputs that are almost valid; what targets share."""
