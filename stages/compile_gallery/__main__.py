"""Show all built animals on one page, with links to their simulators and reports.

It has a command line of its own because it makes no artifact: it looks at whatever is built.

make gallery        or: python -m stages.compile_gallery build
"""

import sys
from pathlib import Path

from pipeline.core.errors import CommandLine, exit_code
from pipeline.workflow import artifact
from stages.compile_gallery import stage


def main(arguments: list[str]) -> int:
    """Write `index.html` into the folder of builds; return 2 where nothing is built."""
    parser = CommandLine(__doc__, prog="python -m stages.compile_gallery")
    parser.add_argument("build", type=Path, help="folder of builds: build")

    def program() -> int:
        given = parser.parse_args(arguments)
        index = given.build / "index.html"
        artifact.write_if_changed(index, stage.run(given.build))
        print(f"written: {index}")
        return 0

    return exit_code(program)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
