"""Names of TensorDict keys, LeRobot columns and Gymnasium ids, in one place."""

DYNAMICS = ("position", "velocity", "acceleration")  # quantities of every rigid body, in the paper's order

GYMNASIUM_IDS = {  # by task
    "balance_reaching": "dynmap_rl/BalanceReaching-v1",
    "balance_reaching_obstacle": "dynmap_rl/BalanceReachingObstacle-v1",
    "bin_dropping": "dynmap_rl/BinDropping-v1",
}
GYMNASIUM_TASK = "dynmap_rl/Task-v0"  # of any task, which is an argument

CAMERAS = "observation.images."  # beginning of the LeRobot columns of frames
CAMERA = f"{CAMERAS}front"  # column of the tasks of cart and block
FRAME_SHAPE = (64, 64, 3)  # of a frame in that column: height, width, RGB

NEEDED = {  # columns that every dataset of the tasks has, by the key that they are loaded as
    "agent_pos": "observation.state",
    "action": "action",
    **{("dynamics", name): f"dynamics.{name}" for name in DYNAMICS},
}
FOUND = "dynamics.found"  # what was found in the frames that dynamics were derived from
OPTIONAL = {  # columns that a dataset may lack, likewise
    ("next", "reward"): "next.reward",
    ("next", "is_success"): "next.success",
    "disturbed": "disturbed",
    "expert_action": "expert_action",
    "labelled": FOUND,
}
