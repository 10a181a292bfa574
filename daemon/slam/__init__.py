"""From motion and crossings to a belief about pose and map."""
