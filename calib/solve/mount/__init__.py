"""`calib mount`: tracks <- fit <- uncertainty, wheels <- experiment."""
