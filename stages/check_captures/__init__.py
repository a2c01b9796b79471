"""Check recordings, up to a minute per file, before hours of work: format, quality, what to do better.

`sampling` reads a few frames, `pose_drift` judges device poses, `moving_objects` looks for the animal,
`overlap` registers sessions to the walk-through, `problems` turns measurements into coded problems with
remedies, `text` writes them out.
"""
