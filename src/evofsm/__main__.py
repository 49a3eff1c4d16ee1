"""`python -m evofsm`, which is `evofsm`."""

from evofsm.cli import main

if __name__ == "__main__":
    main()
