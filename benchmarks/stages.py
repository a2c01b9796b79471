"""Print the cost of a build from its job records: wall and CPU seconds, seconds per frame and peak memory of every
artifact.

    python -m benchmarks.stages cat

Wall seconds depend on the load of the machine, CPU seconds less so.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

from benchmarks import command_lines


@dataclass(frozen=True)
class Cost:
    """Total cost of the jobs of one artifact."""

    artifact: str
    jobs: int
    seconds: float
    cpu_seconds: float
    frames: int
    """Total frames of the recordings; 0 for an artifact that is not per recording."""
    peak_memory_mb: int


def costs(build: Path) -> list[Cost]:
    """Sum the records of a build per artifact, in flow order."""
    jobs = {job["id"]: job for job in json.loads((build / "plan" / "dag.json").read_text())}
    frames = {path.name: len(list((path / "color").glob("*.jpg"))) for path in (build / "frames").iterdir()}
    grouped: dict[str, list[tuple[dict, dict]]] = {}
    for name, job in jobs.items():
        record = build / "records" / f"{name}.json"
        if record.exists():
            grouped.setdefault(job["artifact"], []).append((job, json.loads(record.read_text())))
    return [
        Cost(
            artifact,
            len(done),
            sum(record["seconds"] for _, record in done),
            sum(record.get("cpu_seconds", math.nan) for _, record in done),
            sum(frames.get(job["video"], 0) for job, _ in done if job["video"]),
            max(record["peak_memory_mb"] for _, record in done),
        )
        for artifact, done in grouped.items()
    ]


def table(found: list[Cost]) -> str:
    """Format costs as a Markdown table with a last row for the whole build."""
    lines = ["| artifact | jobs | seconds | CPU s | frames | CPU s / frame | peak MB |", "|---" * 7 + "|"]
    for cost in found:
        per_frame = f"{cost.cpu_seconds / cost.frames:.3f}" if cost.frames else ""
        lines.append(
            f"| {cost.artifact} | {cost.jobs} | {cost.seconds:.0f} | {cost.cpu_seconds:.0f} | {cost.frames or ''} | {per_frame} | {cost.peak_memory_mb} |"
        )
    whole, cpu = sum(cost.seconds for cost in found), sum(cost.cpu_seconds for cost in found)
    lines.append(
        f"| total | {sum(cost.jobs for cost in found)} | {whole:.0f} | {cpu:.0f} | | | {max(cost.peak_memory_mb for cost in found)} |"
    )
    return "\n".join(lines)


def main() -> None:
    """Print the table for one build."""
    parser = command_lines.for_agent(__doc__)
    arguments = parser.parse_args()
    print(table(costs(command_lines.build_of(arguments))))


if __name__ == "__main__":
    main()
