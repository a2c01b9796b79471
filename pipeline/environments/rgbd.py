"""RGB-D camera of a person: color and depth of the reconstruction with the posed animals.

The camera is at eye height and looks ahead and down. Scene and animals are the surfaces of the artifact
`reconstruction`, animals posed by their bones (dual-quaternion blending, as in the reconstruction itself).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data import ply
from pipeline.fields.skinning import SkinnedShape
from pipeline.geometry import rigid
from pipeline.geometry.decimation import decimate
from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from pipeline.geometry.views import shade
from pipeline.longterm.bodies import SkinnedBody, load_body
from pipeline.workflow import artifact

HEIGHT_PX, WIDTH_PX = 48, 64
"""Size of a picture, small enough for a policy network."""
FIELD_RAD = np.deg2rad(80.0)
"""Horizontal field of view, that of a phone's wide camera."""
PITCH_RAD = np.deg2rad(20.0)
"""Downward pitch of the camera: from eye height towards an animal on the floor 4 m away."""
FAR_M = 10.0
"""Maximum depth; larger depths are clipped."""
AGENT_FACES = 2000
"""Triangles of the decimated animal: half a pixel each at one meter."""
FOCAL_PX = WIDTH_PX / 2 / np.tan(FIELD_RAD / 2)
INTRINSICS = np.array([[FOCAL_PX, 0, WIDTH_PX / 2], [0, FOCAL_PX, HEIGHT_PX / 2], [0, 0, 1]])


class RgbdCamera:
    """Renders the surfaces of homes and their animals."""

    def __init__(self, scenes: Sequence[Mesh], bodies: Sequence[SkinnedBody]):
        """``scenes`` are in the world frames of their homes, meters."""
        self.scenes = [RayCaster(scene) for scene in scenes]
        self.bodies: list[tuple[Mesh, SkinnedShape]] = []
        for body in bodies:
            mesh, nearest = decimate(body.mesh, AGENT_FACES)
            skin = SkinnedShape(mesh.vertices, body.weights[nearest], body.agent_from_bone_rest)
            self.bodies.append((mesh, skin))

    @classmethod
    def load(cls, builds: Sequence[Path], homes: Sequence[Path]) -> "RgbdCamera":
        """Open the animals of builds and the surfaces of homes. Raises ART-003 where a build has none,
        ART-007 where another version wrote it.
        """
        for folder in (*builds, *homes):
            remedy = "make it: make <agent>.reconstruction, or leave `rgbd` out of `observations`"
            artifact.require(folder, "reconstruction", remedy=remedy)
        scenes = [ply.read_ply(home / "reconstruction/scene.ply") for home in homes]
        return cls(scenes, [load_body(build / "reconstruction") for build in builds])

    def picture(
        self,
        scene: int,
        eye_world: Float[np.ndarray, "3"],
        heading: float,
        poses: Sequence[tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "bone 4 4"]]],
    ) -> tuple[UInt8[np.ndarray, "48 64 3"], Float[np.ndarray, "48 64"]]:
        """Render from a position (meters) at a heading about +y (radians, 0 along +z): color, and z-depth in
        meters (0: no surface). ``poses`` are `world_from_agent` and `agent_from_bone` of each animal.
        """
        level = np.cos(PITCH_RAD)
        ahead = np.array([np.sin(heading) * level, -np.sin(PITCH_RAD), np.cos(heading) * level])
        camera = rigid.look_at(eye_world, eye_world + ahead, np.array([0.0, 1.0, 0.0]))
        caster = self.scenes[scene]
        depth, hits = render_view(caster, camera, INTRINSICS, HEIGHT_PX, WIDTH_PX)
        rgb = shade(caster.mesh, hits).reshape(HEIGHT_PX, WIDTH_PX, 3)
        for (body, skin), (root, bones) in zip(self.bodies, poses, strict=True):
            world = rigid.apply(np.asarray(root, float), skin.posed(bones))
            posed = RayCaster(Mesh(world.astype(np.float32), body.faces, body.color))
            near, struck = render_view(posed, camera, INTRINSICS, HEIGHT_PX, WIDTH_PX)
            animal = (near > 0) & ((depth == 0) | (near < depth))
            rgb = np.where(animal[..., None], shade(posed.mesh, struck).reshape(rgb.shape), rgb)
            depth = np.where(animal, near, depth)
        return rgb.astype(np.uint8), depth.clip(0, FAR_M).astype(np.float32)
