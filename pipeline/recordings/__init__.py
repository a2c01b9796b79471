"""Phone and depth-camera recordings in every format that is understood, behind one interface.

A format is one file with `open_recording(path) -> Recording` and one line in `formats`.
`extraction.understand` then checks on the depth what device poses mean (`conventions`), finds the quarter
turns (`upright`) and picks frames by time (`extraction.choose_frames`); `extraction.frames` reads picture
by picture. Containers are never unpacked to disk.
"""
