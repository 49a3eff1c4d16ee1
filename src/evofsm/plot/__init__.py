"""Pictures of models, runs and beliefs, and the marks that figures of studies are made of."""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
