"""The declaration of the DAG: which program makes which artifact, from what, for which recordings.

`plan` expands it for an agent's recordings, `run` runs one job of it, and Make and Snakemake see only the
plan. Standard library only, no side effects.
"""

from dataclasses import dataclass, field
from typing import Literal

from pipeline.core.videos import Role, Split, Video

Flow = Literal["recordings", "trajectories"]
"""What an agent's flow starts from: recordings of it, or tables of its motion."""
BUILTIN: dict[Flow, str] = {"recordings": "synthetic_capture", "trajectories": "synthetic_lives"}
"""What replaces recordings if `captures/<agent>/` is empty."""
VIEWED: tuple[Role, ...] = ("walkthrough", "turnaround", "session")
"""Roles that models may see; the held-out phone is for `evaluate` alone."""
AGENT: tuple[Role, ...] = ("turnaround", "session")
"""Roles of recordings that show the animal."""
BOTH: tuple[Flow, ...] = ("recordings", "trajectories")
VARIANTS = {
    "registration": ("no_localizer", "no_feature_metric", "no_odometry", "regression_only", "totalrecon"),
    "reconstruction": (
        "no_localizer", "mlp_fields", "paper_small", "no_feature_loss", "no_annealing", "totalrecon",
        "totalrecon_single",
    ),
}  # fmt: skip
"""Variants of an agent that Tables 1 and 3 compare its registration and its reconstruction with."""
TEMPLATES = ("scene_template", "agent_template")
LOCALIZERS = ("scene_localizer", "agent_localizer")
HOME_ARTIFACTS = ("behavior_data", "feature_basis", "scene_template")
READ_BY_PAGES = ("reconstruction", "splats", "behavior", "behavior_data")


@dataclass(frozen=True)
class Need:
    """One input of a node; for an artifact per recording, of which recordings."""

    artifact: str
    roles: tuple[Role, ...] | None = None
    """None: all recordings that have it."""
    splits: tuple[Split, ...] = ("train", "test", "none")
    part: str | None = None
    """Subfolder that is read; None: the whole artifact."""
    option: str | None = None
    """Command line option without dashes; the artifact's name if None."""
    variants: tuple[str, ...] = ()
    """Variants of the agent whose artifact is read as well, given as the folder `--variants`."""
    flow: Flow | None = None
    """The only flow in which it is an input; None: all flows of the node."""
    measured: bool = False
    """Only recordings with their own depth, and the walk-through: those that the map is built from."""
    per_animal: bool = False
    """In a home of several animals `part` has a subfolder per animal, of which the animal's own is read."""
    others: bool = False
    """That of every other animal (all animals if the node is shared), given as the folder of all animals."""
    readers: tuple[Role, ...] | None = None
    """Roles of the recordings whose jobs read it; None: all."""
    alone: bool = False
    """Read only in homes of one animal."""
    mapped: bool = False
    """Read only by jobs of recordings whose depth comes from the map, and by single jobs if there are any."""
    homes: Literal["any", "own", "other"] = "any"
    """If the table names `homes`, other builds of the animal: its own artifact, or theirs in `build/`."""

    def wants(self, video: Video, made_of: tuple[Role, ...]) -> bool:
        """Return whether a recording is an input; `made_of` are the roles of the needed artifact."""
        roles = made_of if self.roles is None else self.roles
        return video.role in roles and video.split in self.splits and not (self.measured and video.mapped)


@dataclass(frozen=True)
class Node:
    """One artifact, or one per recording, and the program that makes it."""

    artifact: str
    stage: str
    """Program: `python -m stages.<stage>`."""
    needs: tuple[Need | str, ...] = ()
    roles: tuple[Role, ...] = ()
    """One job per recording of these roles; empty: a single job."""
    role_dependencies: tuple[Role, ...] = ()
    """Roles whose recordings and split affect the result without being an input per recording."""
    fixed: dict[str, object] = field(default_factory=dict)
    """Keys of the configuration that distinguish two nodes of one program."""
    version: int = 1
    """Format version: raise it when results or the meaning of files change. Readers refuse other versions."""
    threads: int = 1
    gpu: int = 0
    memory_mb_per_1000_frames: int = 0
    """Memory that a scheduler reserves for the frames that the job reads, beside `engine.MEMORY_MB`."""
    seconds_per_frame: float = 0.02
    """Per frame read, on two cores without a GPU; the scheduler's limit is several times as long."""
    resumable: bool = False
    """Has a folder for checkpoints that survives a kill."""
    distributed: bool = False
    """Can run as several processes with a GPU each."""
    extra_inputs: tuple[str, ...] = ()
    """Optional files or artifacts in the capture folder, passed as `--<stem>`; variants ignore artifacts, as
    they are compared with runs from scratch."""
    sidecars: tuple[str, ...] = ()
    """The same per recording: `<recording>.<name>.toml`, as `--<name>`."""
    flows: tuple[Flow, ...] = ("recordings",)
    """Flows that contain it."""
    trials: Literal["none", "each", "all"] = "none"
    """Only for `make behavior-tables`: one job per trial (a method with a seed), or one over all."""
    table: str | None = None
    """The recipe's table that configures it, if shared with another node."""
    on_demand: bool = False
    """Made only if requested by name, or needed by something that is."""
    mapped: bool = False
    """Made only from recordings whose depth comes from the map."""
    stands_in_for: str | None = None
    """Artifact that it replaces as an input of other nodes, for those recordings."""
    of_several: bool = False
    """Made and read only in a home of several animals, once for all of them; an input of those recordings
    that have it."""
    begins_animal: bool = False
    """In a home of several animals it and everything downstream is made per animal."""

    @property
    def several(self) -> bool:
        """Whether there is one job per recording or trial."""
        return bool(self.roles) or self.trials == "each"


def merging(*artifacts: str, roles: tuple[Role, ...] | None = None) -> tuple[Need, ...]:
    """Return one need per artifact, over the recordings of `roles`."""
    return tuple(Need(artifact, roles) for artifact in artifacts)


TRUTH = Need("synthetic_capture", part="truth", option="truth", per_animal=True)
RECORDING = Need("synthetic_capture", part="recordings", option="recording")
WALK = Need("frames", roles=("walkthrough",), option="walk")
RECOGNIZER = Need("recognizer", readers=("session",), alone=True, mapped=True)
OF_HOMES = (
    *(Need(name, homes="own", flow="recordings") for name in HOME_ARTIFACTS[1:]),
    *(Need(name, option="homes", homes="other", flow="recordings") for name in HOME_ARTIFACTS),
)
# fmt: off
FLOW: tuple[Node, ...] = (
    Node("synthetic_capture", "synthesize_capture", threads=2),
    Node("frames", "extract_frames", (RECORDING,),
         roles=(*VIEWED, "heldout"), sidecars=("depth",), seconds_per_frame=0.006),
    Node("pictures", "extract_frames", (RECORDING,),
         roles=AGENT, table="extract_frames", mapped=True, seconds_per_frame=0.006),
    Node("feature_basis", "fit_feature_basis", (Need("frames", VIEWED, ("train", "none"), measured=True),)),
    Node("features", "extract_features", ("frames", "feature_basis"), roles=VIEWED),
    Node("scene_template", "build_scene_template", merging("frames", "features", roles=("walkthrough",))),
    Node("scene_localizer", "train_localizer",
         ("feature_basis", "scene_template", *merging("frames", roles=("walkthrough",))),
         fixed={"target": "scene"}, gpu=1, distributed=True),
    Node("flow", "estimate_flow", ("frames",), roles=AGENT, seconds_per_frame=0.06),
    Node("identities", "segment_agent.identities", merging("frames", "flow", roles=("turnaround",)),
         of_several=True, seconds_per_frame=0.1),
    Node("home_masks", "segment_agent", ("frames", "flow", "identities"),
         roles=("session",), sidecars=("prompt",), table="segment_agent", of_several=True,
         seconds_per_frame=0.3),
    Node("masks", "segment_agent",
         ("frames", "flow", "home_masks", RECOGNIZER),
         roles=AGENT, sidecars=("prompt",), begins_animal=True, seconds_per_frame=0.11),
    Node("recognizer", "train_recognizer", (WALK, *merging("frames", "masks", roles=("turnaround",))),
         resumable=True, on_demand=True),
    Node("estimated_frames", "estimate_depth",
         ("pictures", Need("frames", roles=("walkthrough",)), "scene_template", RECOGNIZER),
         roles=AGENT, mapped=True, stands_in_for="frames", seconds_per_frame=0.5),
    Node("agent_template", "build_agent_template",
         merging("frames", "masks", "features", roles=("turnaround",))),
    Node("agent_localizer", "train_localizer", ("feature_basis", "agent_template"),
         fixed={"target": "agent"}, gpu=1, distributed=True),
    Node("video_poses", "register_videos",
         ("frames", "masks", "features", *TEMPLATES, *LOCALIZERS, WALK),
         roles=("session",), gpu=1, seconds_per_frame=0.08),
    Node("registration", "gather_registration", merging("video_poses")),
    Node("reconstruction", "reconstruct",
         ("registration", *merging("frames", roles=VIEWED), *merging("masks", "flow", "features"),
          *TEMPLATES),
         role_dependencies=("heldout",), threads=2, gpu=1, memory_mb_per_1000_frames=500,
         seconds_per_frame=0.1, resumable=True, distributed=True, extra_inputs=("former",)),
    Node("splats", "refine_gaussians",
         ("reconstruction", *merging("frames", roles=VIEWED), *merging("masks", "flow")),
         gpu=1, memory_mb_per_1000_frames=300, resumable=True, distributed=True, seconds_per_frame=0.03),
    Node("synthetic_lives", "synthesize_capture.lives", flows=("trajectories",)),
    Node("trajectories", "read_trajectories",
         (Need("synthetic_lives", part="recordings", option="recording"),),
         roles=("session",), flows=("trajectories",)),
    Node("behavior_data", "slice_behavior",
         (Need("reconstruction", flow="recordings"),
          Need("trajectories", flow="trajectories"),
          Need("reconstruction", flow="recordings", option="companions", others=True),
          Need("masks", ("session",), flow="recordings")),
         role_dependencies=("session",), flows=BOTH),
    Node("behavior", "train_behavior", ("behavior_data", *OF_HOMES),
         gpu=1, resumable=True, distributed=True, flows=BOTH),
    Node("longterm_world", "synthesize_capture.motions", on_demand=True),
    Node("longterm_ablations", "train_longterm", ("reconstruction", "behavior_data"),
         fixed={"ablations": "baselines"}, resumable=True, on_demand=True),
    Node("longterm_study", "train_longterm", ("longterm_world",),
         fixed={"ablations": "all"}, resumable=True, on_demand=True),
    Node("behavior_trials", "train_behavior", ("behavior_data", *OF_HOMES),
         table="train_behavior", fixed={"export": False}, gpu=1, resumable=True, flows=BOTH, trials="each"),
    Node("behavior_scores", "score_behavior",
         ("behavior_data", "behavior_trials",
          Need("synthetic_lives", part="approaches", option="approaches", flow="trajectories")),
         flows=BOTH, trials="each"),
    Node("behavior_tables", "tabulate_behavior", ("behavior_data", "behavior_trials", "behavior_scores"),
         flows=BOTH, trials="all"),
    Node("longterm_tables", "tabulate_longterm",
         ("reconstruction", "behavior_data", "behavior",
          "longterm_ablations", "longterm_world", "longterm_study"),
         on_demand=True),
    Node("reconstruction_metrics", "evaluate.reconstruction_metrics",
         (*merging("frames", "masks", "flow"),
          *TEMPLATES, "scene_localizer", "registration", "reconstruction", "splats", TRUTH),
         role_dependencies=("session", "heldout"), table="evaluate", gpu=1, extra_inputs=("clicks.json",)),
    Node("longterm", "train_longterm", ("reconstruction", "behavior_data"), resumable=True, distributed=True),
    Node("simulator", "export_simulator", READ_BY_PAGES),
    Node("home_simulator", "export_simulator.home", tuple(Need(name, others=True) for name in READ_BY_PAGES),
         table="export_simulator", of_several=True),
    Node("evaluation", "evaluate",
         ("reconstruction_metrics", "reconstruction", "behavior_data", "behavior"), gpu=1),
    Node("registration_tables", "evaluate.registration_tables",
         (Need("registration", variants=VARIANTS["registration"]),
          "scene_template", *merging("frames", roles=("walkthrough", "session")), TRUTH),
         on_demand=True),
    Node("reconstruction_tables", "evaluate.reconstruction_tables",
         (Need("reconstruction", variants=VARIANTS["reconstruction"]),
          *TEMPLATES, *merging("frames"), TRUTH),
         on_demand=True),
    Node("report", "report",
         (*merging("frames", "flow", "masks"), "feature_basis", *merging("features"),
          *TEMPLATES, *LOCALIZERS, *merging("video_poses"), "registration", "identities", RECOGNIZER,
          *READ_BY_PAGES, "longterm", "simulator", "reconstruction_metrics", "evaluation")),
)
# fmt: on
NODES = {node.artifact: node for node in FLOW}


def table_of(node: Node) -> str:
    """Return the recipe's table that configures `node`: the program's, or its own if that is shared."""
    shared = sum(other.stage == node.stage and other.table is None for other in FLOW) > 1
    return node.table or (node.artifact if shared or "." in node.stage else node.stage)


def nodes_of(flow: Flow, *, trials: bool = False, several: bool = False) -> tuple[Node, ...]:
    """Return the nodes of one flow in order, those for trials or ``several`` animals only on request."""
    return tuple(
        node
        for node in FLOW
        if flow in node.flows and (trials or node.trials == "none") and (several or not node.of_several)
    )


def folder_of(name: str, video: Video) -> str:
    """Return the artifact that holds `name` of a recording: its stand-in if its depth is the map's."""
    stand_ins = (node.artifact for node in FLOW if node.stands_in_for == name)
    return next(stand_ins, name) if video.mapped else name


def needs_of(node: Node, flow: Flow | None = None) -> tuple[Need, ...]:
    """Return the node's inputs in declared order, only those of ``flow`` if given."""
    needs = tuple(Need(need) if isinstance(need, str) else need for need in node.needs)
    return tuple(need for need in needs if flow is None or need.flow in (None, flow))
