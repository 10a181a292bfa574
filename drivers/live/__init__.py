"""A running robot as other people's systems want it, from what it says on Zenoh."""
