"""ceilvo: localisation of indoor robots that look at the ceiling. Shared vocabulary, no behaviour."""

__version__ = "0.1.0"
