"""The command `agent-to-sim` of an installed package.

    agent-to-sim stage NAME ...    one stage program, for example `agent-to-sim stage segment_agent --help`
    agent-to-sim plan ...          the planner, in a folder with agents/ and captures/
    agent-to-sim run HOME JOB      one planned job
    agent-to-sim doctor            what this machine lacks

In a checkout `make` calls the same modules.
"""

import runpy
import sys
from collections.abc import Sequence

from pipeline.core.errors import InputError, exit_code
from pipeline.workflow import sources


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one of the commands in this process; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)

    def program() -> int:
        module, rest = _module(given)
        sys.argv = [f"agent-to-sim {' '.join(given[: len(given) - len(rest)])}", *rest]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
        return 0

    if given and given[0] not in ("-h", "--help"):
        return exit_code(program)
    print(__doc__)
    return 0


def _module(given: list[str]) -> tuple[str, list[str]]:
    """Return the module that a command line means, and the arguments that are left for it."""
    match given:
        case ["stage", name, *rest] if sources.is_stage(name):
            return f"stages.{name}", rest
        case ["stage", *_]:
            named = f"there is no stage {given[1]!r}" if given[1:] else "which stage?"
            raise InputError("RUN-002", named, "agent-to-sim stage", "names: the folders of stages/")
        case ["plan" | "run" | "doctor" as command, *rest]:
            return f"pipeline.workflow.{command}", rest
    what = f"there is no command {given[0]!r}"
    raise InputError("RUN-003", what, "agent-to-sim", "one of: stage, plan, run, doctor")


if __name__ == "__main__":
    sys.exit(main())
