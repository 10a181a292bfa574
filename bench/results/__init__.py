"""Single results on disk, and the bars they are held to."""
