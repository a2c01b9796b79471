"""Phone and depth-camera recordings in every format that is understood, behind one interface.

A format is one file with `open_recording(path) -> Recording` and one line in `formats`.
`extraction.understand` then checks on the depth what device poses mean (`conventions`), finds the quarter
turns (`upright`) and picks frames by time (`extraction.choose_frames`); `extraction.frames` reads picture
by picture. Containers are never unpacked to disk.

Errors: CAP-001 damaged, CAP-002 unsafe archive, CAP-003 not a recording, CAP-004 broken metadata, CAP-005
Face-ID recording, CAP-006 no depth, CAP-007 no usable frames, CAP-008 wrong depth picture, CAP-009 depth
of a faulty app version, CAP-010 depth that is not metric, CAP-011 no intrinsics, CAP-020 broken picture,
CAP-022 broken EXR.
"""
