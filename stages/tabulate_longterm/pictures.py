"""What the quality page of the tables shows: errors of all methods, and the figures against their bars."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import UInt8

from pipeline.data import plots
from pipeline.data.qa import Check, Picture
from pipeline.metrics.intervals import names_of
from stages.tabulate_longterm.methods import WITHOUT_SCENE

QUALITY = {
    "good": "ours ahead of every rival, and physical after the optimisation at little more error",
    "bad": "a rival ahead, feet that slide, bodies inside furniture",
}
RIVALS = ("base", "route_cvae", "nearest")


def checks(figures: Mapping[str, float | None]) -> list[Check]:
    """Judge the figures by the bars of long-term motion."""

    def of(name: str) -> float | None:
        return figures.get(name)

    def ratio(upper: str, lower: str) -> float | None:
        above, below = of(upper), of(lower)
        return None if above is None or not below else above / below

    found = [
        Check(
            f"MPJPE against {rival}", ratio("longterm/ours/mpjpe_mm", f"longterm/{rival}/mpjpe_mm"), "", 1.0
        )
        for rival in RIVALS
    ]
    found += [
        *(
            Check(
                f"translation against blind to the scene: {name}",
                ratio(f"longterm/{name}/translation", f"longterm/{blind}/translation"),
                "",
                1.0,
            )
            for name, blind in WITHOUT_SCENE.items()
        ),
        Check(
            "non-collision, optimised", of("longterm/ours_opt/non_collision"), "share", 0.995, better="higher"
        ),
        Check("contact, optimised", of("longterm/ours_opt/contact"), "share", 0.97, better="higher"),
        Check("foot slide, optimised", of("longterm/ours_opt/slide_m_s"), "m/s", 0.01),
        Check(
            "MPVPE, optimised against not",
            ratio("longterm/ours_opt/mpvpe_mm", "longterm/ours_same/mpvpe_mm"),
            "",
            1.2,
        ),
        Check(
            "distance of the ends from the given bodies, optimised",
            of("longterm/ours_opt/end_v2v_share"),
            "of body length",
            0.006,
        ),
        Check(
            "neighbour v2v where two motions join, beyond their own, optimised",
            of("longterm/ours_opt/seam_share"),
            "of body length",
            0.006,
        ),
        Check(
            "samples: penetration left",
            ratio("longterm_samples/penetration_m", "longterm_samples/penetration_before_m"),
            "",
            0.5,
        ),
        Check(
            "samples: slide left",
            ratio("longterm_samples/slide_m_s", "longterm_samples/slide_before_m_s"),
            "",
            0.5,
        ),
        Check(
            "samples: goal error left",
            ratio("longterm_samples/goal_error_m", "longterm_samples/goal_error_before_m"),
            "",
            1.03,
        ),
        Check(
            "samples: path error left",
            ratio("longterm_samples/path_error_m", "longterm_samples/path_error_before_m"),
            "",
            1.03,
        ),
        Check("minutes: largest seam", of("longterm_minutes/largest_seam_m"), "m", 0.02),
        Check("minutes: outside of the room", of("longterm_minutes/outside_room_m"), "m", 0.01),
        Check("minutes: deepest vertex inside something", of("longterm_minutes/deepest_m"), "m", 0.02),
    ]
    return found


def pictures(figures: Mapping[str, float | None]) -> list[Picture]:
    """Draw MPJPE of all methods with their intervals."""
    caption = "MPJPE of two-second motions between given bodies: mean and 95 % interval over episodes."
    return [Picture("mpjpe", bars(figures), caption)]


def bars(figures: Mapping[str, float | None]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw one row of bars per source of motion."""
    figure, axes = plots.panels(1, 2, width_in=11, height_in=4)
    for axis, prefix in zip(axes[0], ("longterm", "longterm_recorded"), strict=True):
        ending = "/mpjpe_mm"
        names = [
            name.split("/")[1] for name in figures if name.startswith(f"{prefix}/") and name.endswith(ending)
        ]
        names = [
            name for name in names if figures[f"{prefix}/{name}{ending}"] is not None and name != "truth"
        ]
        mean = np.array([figures[f"{prefix}/{name}{ending}"] for name in names])
        ends = np.array(
            [[figures[each] for each in names_of(f"{prefix}/{name}{ending}")[1:]] for name in names], float
        ).reshape(-1, 2)
        off = np.abs(ends - mean[:, None]).T
        axis.barh(
            names,
            mean,
            xerr=off,
            color=[plots.ORANGE if name.startswith("ours") else plots.BLUE for name in names],
        )
        axis.set(title=prefix, xlabel="mm")
        axis.invert_yaxis()
    return plots.pixels(figure)
