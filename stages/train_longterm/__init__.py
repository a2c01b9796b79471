"""Training of long-term motion: static bodies, routes between them, and poses along routes.

`sources` reads and splits motion, `learning` trains all networks in order, `training` fits a single network,
`objectives` holds the losses, `pictures` evaluates the model on held-out motion.
"""
