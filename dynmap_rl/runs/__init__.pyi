from .folder import open_run as open_run
from .folder import read_metrics as read_metrics
from .lookup import find_run as find_run
from .lookup import load_actor as load_actor
from .lookup import load_world_model_of as load_world_model_of
from .lookup import task_of_run as task_of_run
