"""The scene as a voxel grid in the world: `feature_volume.npz` of a reconstruction or a table of motion."""

from pipeline.data.schema import FileSchema

FEATURE_VOLUME = FileSchema.of(
    "reconstruction/feature_volume.npz",
    "features [channel x y z] f2",
    "occupancy [x y z] u1",
    "origin [3] f8",
    "voxel_m [] f8",
)
