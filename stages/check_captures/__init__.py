"""Check recordings, up to a minute per file, before hours of work: format, quality, what to do better.

`sampling` reads a few frames, `moving_objects` looks for the animal, `overlap` registers sessions to the
walk-through and judges device poses, `problems` turns measurements into coded problems with remedies.
"""
