"""What to do about a check that warns or fails: one sentence each, by artifact and the beginning of the
check's name.
"""

REMEDIES: dict[str, dict[str, str]] = {
    "frames": {
        "duration": "record sessions of 30-60 s and a walk-through of 60-90 s",
        "missing ticks": "close other programs on the phone; record at its usual frame rate",
        "dark": "record by day or switch on the light",
        "blurred": "move the phone slowly; more light shortens the exposure",
        "known depth": "stay between 0.3 and 4 m of what is recorded; glass and black surfaces give no depth",
        "frames dropped": "use a phone with LiDAR, the rear camera, and Record3D's LiDAR mode",
        "scale known": (
            "record one session with a LiDAR phone where the walk-through went: its depth gives the scale"
        ),
        "frames": "the recording is too short, or most of it could not be used: see the checks below",
        "damaged": "copy the recording from the phone again",
        "device poses": (
            "hold the phone still for a second at the start; poses are then "
            "found from pictures alone, more slowly"
        ),
    },
    "flow": {
        "both directions": (
            "more light and slower motion of the phone; look at the pair of pictures with the least agreement"
        )
    },
    "masks": {
        "agent visible": "keep the animal in view; recordings without it teach nothing",
        "flicker": "look at the overlay: where another mover is taken for the animal, record without it",
        "area": "look at the overlay: the mask loses the animal or includes what it touches; record it apart",
        "flashes": "look at the overlay: where another mover is taken for the animal, record without it",
        "frames of low": "look at the overlay of those frames; keep the animal in view, move slowly",
        "masks contradicted": "look at the overlay: static things count as animal; give a box or a click",
        "agreement": "look at the overlay: shadows and people that walk along are taken for the animal",
    },
    "features": {"cosine similarity": "pictures jump: the phone was moved too fast"},
    "feature_basis": {
        "descriptors": "record more: too few pictures for a basis",
        "variance": "record more of the room; one basis serves all recordings",
    },
    "scene_template": {
        "keyframes": (
            "walk once more, slowly, with the phone turned to textured things; every place from two sides"
        ),
        "reprojection": (
            "blurred or moving things in the walk-through: record it without the animal and without people"
        ),
        "scale": "the phone's depth and motion disagree: record the walk-through again, slower",
        "metres": (
            "record one session with a LiDAR phone where the walk-through went: its depth gives the scale"
        ),
        "depth against": "something was moved during the walk-through; record it in one go",
        "frames that fit": "something was moved during the walk-through; record it in one go",
    },
    "agent_template": {
        "circle": "walk the whole circle around the resting animal, about 1.2 m away, 15-20 s",
        "agreement": "the animal moved while it was circled: record the turnaround again",
        "surface": "parts were never seen: hold the phone low once and high once",
        "longer": (
            "look at the turntable: where it does not begin with the head's side, "
            "`[build_agent_template] turn_deg` turns the animal"
        ),
        "head": (
            "look at the turntable: where it does not begin with the head's side, "
            "`[build_agent_template] turn_deg = 180` turns the animal"
        ),
        "bones": "the shape is too coarse: circle closer",
    },
    "scene_localizer": {
        "": "the room looks alike in places: record the walk-through with more of what differs between them"
    },
    "agent_localizer": {"": "the body looks alike from several sides: record the turnaround in better light"},
    "video_poses": {
        "registered": (
            "begin the session with a slow look at the room, so that it overlaps with the walk-through"
        ),
        "frame votes": (
            "furniture was moved since the walk-through, or the light is very "
            "different: record the walk-through again"
        ),
        "depth": "furniture was moved since the walk-through: record it again",
        "appearance": (
            "the light is very different from the walk-through's: record that again in the usual light"
        ),
        "static": "furniture was moved since the walk-through: record it again",
        "camera": "begin the session with a slow look at the room",
        "animal": "keep the whole animal in view, 0.5-3 m away",
    },
    "registration": {"": "open the session's own page: it names what it lacks"},
    "reconstruction": {
        "psnr": (
            "look at the pictures: a blurred reference is the recording's; a blurred render "
            "wants more steps (`[reconstruct]` in the recipe)"
        ),
        "measured depth": (
            "look at where depth differs: moved furniture, glass, or a session that is not well placed"
        ),
        "agent's": "look at the masks of this recording first; then give the body more steps in the recipe",
    },
    "splats": {
        "": "give more Gaussians or steps (`[refine_gaussians]` in the recipe); a GPU makes both cheap"
    },
    "behavior_data": {
        "training windows": "record more and longer sessions; the animal has to move in some",
        "test windows": "the last session is the test: make it as long as the others",
        "recordings in both": "this must not be: report it",
        "valid": "keep the animal in view",
    },
    "behavior": {
        "goals move": (
            "record approaches: somebody walks at the animal, from several sides, in several sessions"
        ),
        "share": "record approaches: somebody walks at the animal, from several sides, in several sessions",
        "onnx": "this must not be: report it",
        "training fell": "look at the losses; a smaller learning rate (`[train_behavior]`) helps",
        "": "record more sessions; minutes of behaviour are learned by heart, hours are not",
    },
    "longterm": {
        "l1": (
            "record more and longer sessions with walks from place to place; then "
            "more steps (`[train_longterm]` in the recipe)"
        ),
        "bodies": (
            "look at the agent in the reconstruction: where it sinks into what "
            "it stands on, long-term bodies do so too"
        ),
        "contact": "look at the agent in the reconstruction: its feet must come near the floor",
        "spread": "give the pose space more components (`[train_longterm]` in the recipe)",
    },
    "simulator": {
        "size": (
            'lower `scene_splats` or `scene_faces`, or set `layout = "folder"` '
            "(`[export_simulator]` in the recipe)"
        ),
        "recorded motion": "the scene has holes where the animal walked: film that floor in the walk-through",
        "skinning": (
            "where bones twist by more than a right angle four linear weights "
            "cannot follow, eight (`--influences 8`) a little"
        ),
        "sessions": "a session counts when it shows the animal for 1.6 s without a break",
    },
    "evaluation": {
        "registration": "look at Sessions on the map: which recording is off, and what its page says",
        "masks": (
            "look at the masks' overlays; a box or a click on the animal (`python "
            "-m stages.segment_agent --prompt`) helps"
        ),
        "reconstruction": (
            "look at 4D reconstruction; a GPU and more steps (`[reconstruct]` in the recipe) help"
        ),
        "behavior": (
            "record more sessions: a rival that predicts as well means that "
            "the model has learned little from these"
        ),
    },
}


def remedy(artifact: str, check: str) -> str:
    """Return what to do, or nothing where nothing is known."""
    known = REMEDIES.get(artifact, {})
    return next((words for begin, words in known.items() if check.lower().startswith(begin)), "")
