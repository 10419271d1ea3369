from .bodies import Body as Body
from .fetch import FetchPush as FetchPush
from .fetch import FetchSlide as FetchSlide
from .meta_world import PlateSlide as PlateSlide
from .meta_world import Soccer as Soccer
from .rendering import Camera as Camera
from .task import MujocoTask as MujocoTask
from .task import MujocoWorld as MujocoWorld
