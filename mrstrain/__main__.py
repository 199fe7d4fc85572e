"""The command `mrstrain` and `python -m mrstrain`: no package is imported that may belong to another distribution."""

import gc
import sys

from mrstrain.cli.wrapping import wrapped
from mrstrain.records.doctor import ForeignPackageError, refuse_foreign_packages


def main() -> None:
    """Run the command line, unless one of its packages belongs to another distribution."""
    try:
        refuse_foreign_packages()
    except ForeignPackageError as error:
        print(wrapped(f"mrstrain: {error}"), file=sys.stderr)
        sys.exit(2)
    gc.set_threshold(20_000, 20, 20)  # what is imported stays: collected as often as usual, imports take a tenth longer
    from mrstrain.cli.app import main as command_line

    command_line()


if __name__ == "__main__":
    main()
