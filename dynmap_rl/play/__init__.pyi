from .session import Session as Session
from .window import PlayWindow as PlayWindow
