"""Run folders: settings, metrics, training state, and functions that find a run again."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
