"""The command ``evofsm``, also as ``python -m evofsm``."""

import sys

from evofsm.extras import refuse_without_command_line


def main() -> None:
    """Run the command line."""
    try:
        refuse_without_command_line()
        from evofsm.cli.app import application, run

        run(application)
    except KeyboardInterrupt:  # while it is loaded; commands say so themselves
        print("evofsm: stopped before the end", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
