"""Names of TensorDict keys, LeRobot columns and Gymnasium ids, in one place."""

DYNAMICS = ("position", "velocity", "acceleration")  # quantities of every rigid body, in the paper's order

GYMNASIUM_IDS = {  # by task
    "balance_reaching": "dynmap_rl/BalanceReaching-v0",
    "balance_reaching_obstacle": "dynmap_rl/BalanceReachingObstacle-v0",
    "bin_dropping": "dynmap_rl/BinDropping-v0",
}
