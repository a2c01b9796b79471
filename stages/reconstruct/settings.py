"""The numbers that steer the reconstruction, grouped as its modules use them."""

from dataclasses import dataclass, replace
from typing import Literal


@dataclass(frozen=True)
class Weights:
    """How much each loss counts, after averaging over its elements."""

    distance: float = 1.0
    """signed distance of the scene at and near measured depth"""
    agent_distance: float = 2.0
    """signed distance of the agent at and near measured depth"""
    color: float = 4.0
    """colour at measured surfaces"""
    feature: float = 0.5
    """features at measured surfaces (feature-metric loss)"""
    rendered_color: float = 2.0
    """colour of composite rendering"""
    rendered_feature: float = 0.2
    """features of composite rendering"""
    rendered_depth: float = 0.1
    """depth of composite rendering"""
    silhouette: float = 0.2
    """the agent's rendered opacity against its mask"""
    flow: float = 0.1
    """where rendered points are seen some frames later"""
    eikonal: float = 0.05
    """gradients of signed distance have length 1"""
    cycle: float = 1.0
    """backward then forward warp returns, per decimetre"""
    outside: float = 2.0
    """posed surface outside the mask, per decimetre"""
    cover: float = 2.0
    """masked pixels that the posed surface leaves bare, per decimetre"""
    in_front: float = 0.5
    """posed surface in space seen free, per decimetre"""
    solid: float = 2.0
    """posed surface inside solid things, the ground above all, per decimetre"""
    rigidity: float = 5.0
    """bones agree where they meet, per decimetre"""
    smoothness: float = 0.3
    """accelerations of root and bones"""
    still: float = 0.1
    """steps of the bones, not squared: most of the time most of an animal rests; those of the root count half"""
    planted: float = 0.3
    """soles that touch something stay where they are, 0 at rest to 1 in motion"""
    rest: float = 0.05
    """bones stay near rest"""
    drift: float = 0.1
    """corrections of neighbouring camera knots agree (relative motion of registration), per centimetre"""
    anchor: float = 0.05
    """corrections of cameras are small, per centimetre"""
    root: float = 0.005
    """the agent's root stays near the registered one, per 5 cm and 3 degrees"""
    template: float = 10.0
    """the agent's field stays near its template, in shape and colour"""


@dataclass(frozen=True)
class Steps:
    """How long each phase runs."""

    template: int = 200
    """steps that copy the agent template into the agent field"""
    scene: int = 1000
    """steps of the first phase: scene and cameras"""
    body: int = 60
    """steps per chunk that pose the template to the masked depth"""
    stance: int = 20
    """steps per chunk and stance, before: does the agent sit?"""
    joint: int = 1000
    """steps of the second phase: everything"""
    body_chunk_frames: int = 100
    """frames posed together"""
    save_every: int = 200
    """steps between checkpoints"""


@dataclass(frozen=True)
class Batches:
    """How much each step looks at."""

    scene_rays: int = 1024
    """rays a step in the first phase"""
    joint_scene_rays: int = 512
    """rays of the scene a step in the second phase"""
    rendered_rays: int = 96
    """rays of composite rendering a step"""
    runs: int = 8
    """stretches of consecutive frames a step in the second phase"""
    run_frames: int = 4
    """frames of each stretch"""
    agent_rays: int = 32
    """rays on the agent per frame and step"""
    posed_rays: int = 96
    """the same while the template is posed"""
    surface_points: int = 96
    """points of the agent's surface per frame and step"""
    posed_points: int = 384
    """and while the template is posed"""
    near: int = 4
    """samples of a ray near its measured depth"""
    free: int = 3
    """samples of a ray in the free space before it"""
    places: Literal["measured", "even"] = "measured"
    """where the scene is asked along its rays: at, around and before measured depth; or evenly, and by rendering alone (rivals)"""
    even: int = 64
    """samples of a ray that is asked evenly; a sixth as many rays are taken then"""
    swap_first: float = 1.0
    """how often a ray takes another video's code as a phase begins (scene annealing)"""
    swap_last: float = 0.05
    """and as it ends"""

    def share(self, size: int) -> "Batches":
        """Return what one of ``size`` processes looks at."""
        counts = ("scene_rays", "joint_scene_rays", "rendered_rays", "runs")
        return replace(self, **{name: -(-getattr(self, name) // size) for name in counts})


@dataclass(frozen=True)
class Rates:
    """Learning rates of AdamW; all fall to a twentieth along a cosine."""

    grid: float = 2e-2
    """grids of the fields"""
    heads: float = 4e-3
    """the fields' small networks and codes"""
    camera: float = 5e-5
    """corrections of cameras, metres and radians"""
    body: float = 2e-2
    """the root and slow turns of limbs while the template is posed, metres and radians"""
    body_frame: float = 1e-2
    """bones, and turns of limbs from frame to frame, the same"""
    motion: float = 5e-4
    """root and bones in the second phase, metres and radians"""
    agent: float = 0.2
    """share of the rates above for the agent's field in the second phase"""
    skin: float = 2e-3
    """bone sizes and the correction of skinning weights"""
