"""The room of long-term motion: learns bodies at sub-goals, routes between them and poses along routes.

`examples` cuts short motions and bodies out of trajectories, `objectives` holds the losses, `training` fits one network
after the other, `pictures` shows what they do on motion they have not seen.
"""
