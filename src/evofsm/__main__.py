"""The command ``evofsm``, also as ``python -m evofsm``."""

import os
import sys

from evofsm.extras import refuse_without_command_line


def main() -> None:
    """Run the command line."""
    if sys.stdout is None:  # closed: answers that nobody can read are none
        sys.stdout = os.fdopen(os.open(os.devnull, os.O_RDONLY))
    if sys.stderr is None:  # closed: notices are no answers
        sys.stderr = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")
    try:
        refuse_without_command_line()
        from evofsm.cli.app import application, run

        run(application)
    except KeyboardInterrupt:  # while it is loaded; commands say so themselves
        print("evofsm: stopped before the end", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
