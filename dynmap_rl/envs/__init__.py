"""Tasks, their simulator, and its environments for Gymnasium and TorchRL; a world model as transform and as environment."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
