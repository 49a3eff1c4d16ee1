"""A safety filter that learns, from an evolving finite state machine.

The public names load on first use, so that ``import evofsm`` itself costs next to nothing.
"""

from __future__ import annotations

import lazy_loader

__version__ = "0.1.0"

try:
    __getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
except ValueError as error:
    remedy = "pack all of it (pyinstaller --collect-all evofsm), and in no zip"
    raise ImportError(f"evofsm lacks files that lie beside its modules: {remedy}") from error
