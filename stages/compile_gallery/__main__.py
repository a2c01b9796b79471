"""Show all built animals on one page, with links to their simulators and reports.

It has a command line of its own because it makes no artifact: it looks at whatever is built.

make gallery        or: python -m stages.compile_gallery build
"""

import argparse
import sys
from pathlib import Path

from pipeline.core.errors import InputError
from pipeline.workflow import artifact
from stages.compile_gallery import stage


def main(arguments: list[str]) -> int:
    """Write `index.html` into the folder of builds; return 2 where nothing is built."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("build", type=Path, help="folder of builds: build")
    given = parser.parse_args(arguments)
    try:
        page = stage.run(given.build)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    artifact.write_if_changed(given.build / "index.html", page)
    print(f"written: {given.build / 'index.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
