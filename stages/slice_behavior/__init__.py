"""Turn reconstructed motion into what behavior models learn from.

`reading` opens the reconstruction or tables of motion, `gridding` puts motion on an even time grid, `windows`
lists the windows of the split and the voxels in which the animal may be, `pictures` judges it.

Errors: BEH-001 no training window, BEH-002 recordings of different bodies.
"""
