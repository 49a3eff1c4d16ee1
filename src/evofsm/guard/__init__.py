"""The guard beside any controller: it judges what is proposed, revises, learns, and writes it down.

Nothing here knows who the controller is or where it drives.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
