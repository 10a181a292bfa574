"""The daemon's wires as other people's programs read them."""
