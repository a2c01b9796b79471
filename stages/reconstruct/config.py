"""Settings of the reconstruction, grouped as its modules use them."""

from dataclasses import dataclass, replace
from typing import Literal


@dataclass(frozen=True)
class PixelSampling:
    """How many pixels of a frame are kept as rays."""

    scene_per_frame: int = 256
    """anywhere in the picture except on the agent"""
    agent_per_frame: int = 160
    """on the agent's mask and in a ring around it"""


@dataclass(frozen=True)
class FieldSizes:
    """Sizes of the fields."""

    scene_voxel_m: tuple[float, ...] = (0.32, 0.16, 0.08)
    """cell sizes of the scene's grids, meters; `mlp` encodes wavelengths down to twice the finest"""
    agent_voxel_m: tuple[float, ...] = (0.06, 0.03, 0.015)
    """cell sizes of the agent's grids, meters"""
    encoding: Literal["grid", "mlp"] = "grid"
    """multi-resolution dense grids, or the paper's MLP with positional encoding"""
    width: int = 64
    """units of each hidden layer"""
    code_channels: int = 8
    """length of each video's code of the scene; 0 = one scene for all videos, without codes (baselines)"""


@dataclass(frozen=True)
class SceneFusion:
    """How depth is fused into the scene's geometry."""

    voxel_m: float = 0.03
    """edge of a voxel, meters"""


@dataclass(frozen=True)
class LossWeights:
    """Weight of each loss after averaging over its elements (ATS, Eq. 6)."""

    distance: float = 1.0
    """signed distance of the scene at and near measured depth"""
    agent_distance: float = 2.0
    """signed distance of the agent at and near measured depth"""
    color: float = 4.0
    """color at measured surfaces"""
    feature: float = 0.5
    """features at measured surfaces (feature-metric loss)"""
    rendered_color: float = 2.0
    """color of composite rendering"""
    rendered_feature: float = 0.2
    """features of composite rendering"""
    rendered_depth: float = 0.1
    """depth of composite rendering"""
    silhouette: float = 0.2
    """the agent's rendered opacity against its mask"""
    flow: float = 0.1
    """optical flow of rendered points"""
    eikonal: float = 0.05
    """gradients of signed distance have length 1"""
    cycle: float = 1.0
    """cycle consistency of backward and forward warp, per decimeter"""
    template: float = 10.0
    """distance of the agent's field from its template, in shape and color"""
    posed_surface: float = 1.0
    """factor of the posed surface's losses against mask, free space and solid things (weights in `body`)"""
    motion_prior: float = 1.0
    """factor of the priors on joints, rest pose and smooth motion (weights in `body`)"""
    planted: float = 0.3
    """foot skate of soles in contact"""


@dataclass(frozen=True)
class PhaseSteps:
    """Optimization steps of each phase."""

    template: int = 200
    """steps that fit the agent's field to the agent template"""
    scene: int = 1000
    """steps of the first phase: scene and cameras"""
    body: int = 60
    """steps per segment that pose the template to the masked depth"""
    joint: int = 1000
    """steps of the second phase: everything"""
    save_every: int = 200
    """steps between checkpoints"""


@dataclass(frozen=True)
class RayBatches:
    """Batch sizes of a step."""

    scene_rays: int = 1024
    """rays a step in the first phase"""
    joint_scene_rays: int = 512
    """rays of the scene a step in the second phase"""
    rendered_rays: int = 96
    """rays of composite rendering a step"""
    rendered_samples: int = 24
    """samples along each rendered ray"""
    runs: int = 8
    """runs of consecutive frames a step in the second phase"""
    swap_first: float = 1.0
    """probability that a ray takes another video's code as optimization begins (scene annealing)"""
    swap_last: float = 0.05
    """and as it ends"""

    def share(self, size: int) -> "RayBatches":
        """Return the batch sizes of one of ``size`` processes."""
        counts = ("scene_rays", "joint_scene_rays", "rendered_rays", "runs")
        return replace(self, **{name: -(-getattr(self, name) // size) for name in counts})


@dataclass(frozen=True)
class LearningRates:
    """Learning rates of AdamW; all fall to a twentieth along a cosine."""

    grid: float = 2e-2
    """grids of the fields"""
    heads: float = 4e-3
    """the fields' networks and codes"""
    camera: float = 5e-5
    """corrections of cameras, meters and radians"""


@dataclass(frozen=True)
class Config:
    """Settings of the reconstruction."""

    seed: int = 0
    """of all randomness"""
    sessions: Literal["all", "filmed_twice"] = "all"
    """what is reconstructed together: all registered sessions and the walk-through, or one session alone
    (single-video baselines): the first that a held-out phone filmed too, else the first"""
    scene_geometry: Literal["fused", "learned"] = "fused"
    """the scene's signed distance: fused depth, which stays fixed, or learned by its field"""
    supervision: Literal["measured", "rendered"] = "measured"
    """losses at and before measured depth besides rendered ones, or differentiable rendering alone, with
    uniform and importance samples along each ray (as in the paper)"""
    certain_gap_s: float = 0.75
    """the agent's pose is interpolated over gaps without observation; in gaps longer than this, seconds, its
    confidence is at most 0.05"""
    sampling: PixelSampling = PixelSampling()
    """pixels kept of each frame"""
    fields: FieldSizes = FieldSizes()
    """sizes of the fields"""
    fusion: SceneFusion = SceneFusion()
    """how depth is fused"""
    steps: PhaseSteps = PhaseSteps()
    """length of each phase"""
    batches: RayBatches = RayBatches()
    """batch sizes"""
    weights: LossWeights = LossWeights()
    """weights of the losses"""
    rates: LearningRates = LearningRates()
    """learning rates"""
