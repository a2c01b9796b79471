"""Estimate how the depth camera differs from the color camera: focal length, pose, and time.

`depth_steps` finds outlines in depth and the picture's edges across them, `estimation` fits the camera to
many frames, `recordings` reads frames of a recording, decides whether the result is clear, and applies it;
`given` reads what the user says instead.
"""
