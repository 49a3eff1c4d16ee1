"""The command ``evofsm``, also as ``python -m evofsm``."""

from typing import Any

from evofsm.extras import refuse_without_command_line


def main() -> None:
    """Run the command line."""
    refuse_without_command_line()
    from evofsm.cli.app import run

    run(application)


def application() -> Any:
    """All commands."""
    from evofsm.cli.app import application as commands
    from evofsm.paper import Paper

    return commands(Paper)


if __name__ == "__main__":
    main()
