"""`ceilvod doctor`: what can be looked at without driving."""
