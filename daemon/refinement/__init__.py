"""A map made better from all that was seen: sparse least squares over key poses, landmarks and the calibration."""
