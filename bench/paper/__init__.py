"""The paper's experiment with its rivals."""
