"""The method on 64-bit ARM: emulated, and computed."""
