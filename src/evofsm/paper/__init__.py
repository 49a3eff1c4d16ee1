"""The paper's reproduction: its 80 runs, every claim, figures and a page that says so."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
