"""The programs: the command line, the live page, drives that can be resumed, what they print."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
