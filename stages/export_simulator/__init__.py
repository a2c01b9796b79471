"""The simulator page and the animated files: surfaces are thinned, weights re-fitted, motion resampled, all
packed.
"""
