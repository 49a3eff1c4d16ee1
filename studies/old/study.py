"""What a study is: a question, how much is done to answer it, and a chapter with the answer.

Every study is a frozen dataclass that derives from `Study`, and stands once in
`studies.old.studies.STUDIES`; ``python -m studies`` and the docs read it there.
Its fields say how much is done; those made by `shim.option` are the options of its command.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, Self, TypeVar

from studies.old.frame import Frame, Progress, silent
from studies.old.shim import is_required

if TYPE_CHECKING:
    from rich.console import Console

    from studies.old.chapter import Chapter


class Findings(Protocol):
    """What a study found."""

    @property
    def frame(self) -> Frame:
        """Every row, for programs."""


F = TypeVar("F", bound=Findings)


@dataclass(frozen=True)
class Study(ABC, Generic[F]):
    """A question, and how much is done to answer it. The docstring is the help of its command."""

    id: ClassVar[str]  #: of its command and in addresses, such as ``"detection"``
    question: ClassVar[str]  #: that it asks, the title of its chapter
    doing: ClassVar[str]  #: what its progress bar says
    short: ClassVar[str]  #: what `shortened` leaves, for the help
    program: ClassVar[str] = "python -m studies"  #: that its command is of
    #: Packages that it needs, with the extra that brings each.
    needed: ClassVar[Mapping[str, str]] = {"scipy": "study"}

    @abstractmethod
    def shortened(self) -> Self:
        """A look, not evidence: the same in a minute or a few."""

    @abstractmethod
    def run(self, progress: Progress = silent, workers: int | None = None) -> F:
        """Do it.

        Parameters
        ----------
        progress : callable
            Called with the number of tasks done, and of all tasks.
        workers : int, optional
            Processes; one per core if not given. The numbers do not depend on it.
        """

    @abstractmethod
    def tell(self, found: F) -> Chapter:
        """What was found, in words, tables, and figures that are still to be drawn."""

    def chapter(self, found: F, folder: Path, command: str, progress: Progress = silent) -> Chapter:
        """What was found, with its figures drawn.

        Parameters
        ----------
        found
            What `run` returned.
        folder : Path
            Where the figures are put.
        command : str
            What was typed to get it.
        progress : callable
            Called with the number of figures drawn, and of all figures.
        """
        return replace(self.tell(found), command=command).drawn(folder, progress)

    def document(self, found: F) -> object:
        """What is written as JSON beside the page."""
        return found.frame.as_dicts()

    def say(self, out: Console, found: F, chapter: Chapter) -> None:
        """Print what was found in the terminal."""
        from studies.old.terminal import print_chapter

        print_chapter(out, chapter)

    @classmethod
    def in_short(cls, **given: Any) -> Self | None:
        """Its short form with those of the given fields that it has; None if it lacks one."""
        mine = {one.name: given[one.name] for one in fields(cls) if one.name in given}
        if any(is_required(one) and mine.get(one.name) is None for one in fields(cls)):
            return None
        return cls(**mine).shortened()

    @property
    def command(self) -> str:
        """The command of the long form, with what it cannot do without."""
        told = [one for one in fields(self) if is_required(one)]
        asked = [f"--{one.name} {getattr(self, one.name)}" for one in told]
        return " ".join([f"{self.program} {self.id}", *asked])
