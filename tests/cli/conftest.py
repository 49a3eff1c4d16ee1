"""What tests of commands share."""

import pytest


@pytest.fixture(scope="session")
def evofsm():
    """Run a command as on the command line."""
    pytest.importorskip("typer")
    pytest.importorskip("rich")
    from typer.testing import CliRunner

    from evofsm.cli.app import application

    return lambda *words: CliRunner().invoke(application(), [*map(str, words)])
