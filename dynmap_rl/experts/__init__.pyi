from .network import ExpertNetwork as ExpertNetwork
from .network import list_checkpoints as list_checkpoints
from .network import load_expert as load_expert
from .network import make_actor as make_actor
from .network import play_to_end as play_to_end
