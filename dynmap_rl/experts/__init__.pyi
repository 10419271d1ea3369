from .network import ExpertNetwork as ExpertNetwork
from .network import list_checkpoints as list_checkpoints
from .network import load_expert as load_expert
from .network import make_actor as make_actor
from .network import roll_out as roll_out
