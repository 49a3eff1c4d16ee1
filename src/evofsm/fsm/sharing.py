"""What threads share: a lock each, and calls that are done as a whole or not at all."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from functools import wraps
from threading import RLock
from typing import Any, TypeAlias, TypeVar, cast

Method = TypeVar("Method", bound=Callable[..., Any])
#: Takes back what was done since it was made; twice is as good as once.
Rollback: TypeAlias = Callable[[], None]

# So many steps are gone through again at most.
_MOST_STEPS = 512


def share(shared: Any) -> None:
    """Give an object a lock, so that threads may share it: its ``_lock``."""
    shared._lock = RLock()
    shared._call = None  # what takes back a transaction under way


def unshared(shared: Any) -> dict[str, Any]:
    """What a copy gets of it, which has a lock of its own."""
    return {name: value for name, value in vars(shared).items() if name not in ("_lock", "_call")}


def alone(method: Method) -> Method:
    """A method of what is shared, during which no other thread changes it."""

    @wraps(method)
    def locked(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self._lock:
            return method(self, *args, **kwargs)

    return cast(Method, locked)


def transaction(method: Method) -> Method:
    """A method that is `alone`, and done as a whole: where it raises, all is as before.

    Its object's ``_savepoint`` returns what takes back whatever is done from then on.
    """

    @wraps(method)
    def done(self: Any, *args: Any, **kwargs: Any) -> Any:
        if self._lock._is_owned():  # within another call, with which it is taken back
            return method(self, *args, **kwargs)
        with self._lock:
            if self._call is not None:  # an interrupt broke off the taking back, too
                self._call()
            rollback: Rollback = self._savepoint()
            try:
                self._call = rollback
                result = method(self, *args, **kwargs)
                self._call = None
                return result
            except BaseException:
                rollback()
                self._call = None
                raise

    return cast(Method, done)


def as_now(shared: Any, *lists: str) -> Rollback:
    """What gives it the attributes of now back, and lists of these names their lengths of now."""
    attributes, lengths = {**vars(shared)}, {name: len(getattr(shared, name)) for name in lists}

    def rollback() -> None:
        vars(shared).update(attributes)
        for name, length in lengths.items():
            del attributes[name][length:]

    return rollback


class Retraced:
    """What is taken back by going through its latest steps again: that costs nothing before.

    What changes it is under `step`.
    """

    _known: tuple[Any, list[tuple[Any, Any, Any]]] | None = None  # a copy, and the steps since
    _twin: Callable[[Any], Any] = staticmethod(deepcopy)

    def savepoint(self) -> Rollback:
        """What takes back all that it learns from now on."""
        if self._known is None:
            self._known = self._twin(self), []
        (before, steps), count = self._known, len(self._known[1])

        def rollback() -> None:
            again = self._twin(before)
            for method, args, kwargs in steps[:count]:
                method(again, *args, **kwargs)
            vars(self).update(unshared(again), _known=None)

        return rollback

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_known": None}


def step(method: Method) -> Method:
    """A method that changes what is `Retraced`, by arguments that nobody changes later."""

    @wraps(method)
    def noted(self: Any, *args: Any, **named: Any) -> Any:
        history, self._known = self._known, None  # of a step that is broken off nothing is known
        result = method(self, *args, **named)
        if history is not None and len(history[1]) < _MOST_STEPS:
            history[1].append((method, args, named))
            self._known = history
        return result

    return cast(Method, noted)
