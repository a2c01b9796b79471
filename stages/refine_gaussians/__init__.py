"""Replace the fields by 3D Gaussians and refine them, and the motion, against the pictures.

`views` reads one frame at drawing size; `refine` holds losses and optimisation; `pictures` shows the result.
"""
