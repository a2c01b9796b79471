"""Optical flow of one video between frames 1, 2, 4 and 8 apart, both ways, with a confidence.

`estimation` searches neighboring frames, chains flows over longer gaps, samples them on the stored grid and
lets the two directions judge each other; `pictures` draws the quality page.
"""
