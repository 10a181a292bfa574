"""What went into a pipeline and what came of it: recorded, read back, drawn and compared."""
