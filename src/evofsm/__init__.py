"""A safety filter that learns, from an evolving finite state machine.

The public names load on first use, so that ``import evofsm`` itself costs next to nothing.
"""

from __future__ import annotations

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
