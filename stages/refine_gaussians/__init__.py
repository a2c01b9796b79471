"""Replace the fields by 3D Gaussians and refine them, and the motion, against the pictures.

`views` reads videos and frames at rendering resolution; `cover` initializes Gaussians on the surfaces;
`refine` holds losses and optimization; `pictures` reports the result.
"""
