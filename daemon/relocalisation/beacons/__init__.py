"""Absolute senses: ranges to radio anchors, and marks. They help a search and bridge gaps; a good fix stays."""
