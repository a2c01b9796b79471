"""The room of long-term motion: learns bodies at sub-goals, routes between them and poses along routes.

`sources` opens motion and parts it, `learning` trains all networks in their order, `training` fits one of
them, `objectives` holds the losses, `pictures` shows what they do on motion they have not seen.
"""
