"""The simulator page and the animated files: surfaces thinned, weights re-fitted, motion resampled."""
