"""Files that last, checkpoints and sealed logs: written whole or not at all, checked when read."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
