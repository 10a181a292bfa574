"""Sections of config.yaml that others than the method read; ceilvo.config.schema has the rest."""
