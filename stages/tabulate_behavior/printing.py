"""The tables as text."""

from collections.abc import Mapping

from pipeline.metrics.intervals import aligned, formatted_interval

END_TO_END = (
    ("goal_minde_m", "goal [m]"),
    ("path_minade_m", "path [m]"),
    ("orientation_minade_rad", "orientation [rad]"),
    ("joints_minade_rad", "joints [rad]"),
    ("goal_energy_score_m", "energy score [m]"),
    ("solid", "in solid"),
)
NETWORKS = (
    ("networks_goal_minde_m", "goal [m]"),
    ("networks_goal_energy_score_m", "energy score [m]"),
    ("networks_path_minade_m", "path [m]"),
    ("networks_solid", "in solid"),
)
TRUTH_FED = (
    ("truth_fed_path_minade_m", "path [m]"),
    ("truth_fed_orientation_minade_rad", "orientation [rad]"),
    ("truth_fed_joints_minade_rad", "joints [rad]"),
)
FLIGHT = (
    ("flees_seen", "person walks up"),
    ("flees_unseen", "person not perceived"),
    ("flees_standing", "person stands"),
)


def tables(figures: Mapping[str, float | None], methods: tuple[str, ...], samples: int = 16) -> str:
    """Return Tables 4 and 5 of the paper, and how often the animal flees, as text: mean [95 % interval]."""
    projected = "plans projected out of solid space, snapped to goals, redrawn"
    parts = [
        table(f"Table 4: end to end, best of {samples} samples; {projected}", END_TO_END, figures, methods),
        table("Table 4 by the networks alone, as in the paper", NETWORKS, figures, methods),
        table("Table 5: given the true goal, and the true path; networks alone", TRUTH_FED, figures, methods),
    ]
    if "behavior/ats/flees_true" in figures:
        walking, standing = (figures[f"behavior/ats/flees_true{end}"] for end in ("", "_standing"))
        true = f"(the animal itself: {walking:.1%}, standing {standing:.1%})"
        parts.append(
            table(f"Share of approaches from which the animal flees {true}", FLIGHT, figures, methods)
        )
    return "\n\n".join(parts)


def table(
    title: str,
    columns: tuple[tuple[str, str], ...],
    figures: Mapping[str, float | None],
    methods: tuple[str, ...],
) -> str:
    """Return one table, without methods that have none of its figures."""
    rows = [["method", *(head for _, head in columns)]]
    for method in methods:
        cells = [formatted_interval(figures, f"behavior/{method}/{name}", ".3f") for name, _ in columns]
        if any(text != "-" for text in cells):
            rows.append([method, *cells])
    return aligned(title, rows)
