"""The command ``evofsm``, also as ``python -m evofsm``."""

from evofsm.extras import refuse_without_command_line


def main() -> None:
    """Run the command line."""
    refuse_without_command_line()
    from evofsm.cli.app import application, run

    run(application)


if __name__ == "__main__":
    main()
