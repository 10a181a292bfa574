"""The commands `ceilvod map`: looking at maps and editing them."""
