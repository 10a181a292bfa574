"""From a frame to its lines and crossings, with the memory of the frames before."""
