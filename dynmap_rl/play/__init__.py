"""Tasks to be played and watched: a session without a window, and the window."""

from .session import DRIVERS, Hand, Session
from .window import PlayWindow

__all__ = ["DRIVERS", "Hand", "PlayWindow", "Session"]
