"""Evaluation in closed loop with drop rate, position error and success rate; held-out errors; probes of world models."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
