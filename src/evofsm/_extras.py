"""What to say where a package of an extra is not installed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needs(package: str, extra: str, purpose: str) -> Iterator[None]:
    """Let an import that fails for want of an extra name the command that installs it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{purpose} needs {package}: pip install 'evofsm[{extra}]'"
        ) from error
