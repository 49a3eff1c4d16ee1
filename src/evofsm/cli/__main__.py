"""`python -m evofsm.cli`."""

from evofsm.cli import main

main()
