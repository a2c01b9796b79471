"""Replace the fields by 3D Gaussians and refine them, and the motion, against the pictures.

`views` opens the videos and reads one frame at drawing size; `cover` lays the first Gaussians where pictures
show most; `refine` holds losses and optimisation; `pictures` shows the result.
"""
