import torch

from dynmap_rl.envs.world import EPISODE_STEPS
from dynmap_rl.evaluation import episode_rows, evaluate, roll_out, scene_seeds
from dynmap_rl.modules import Actor, make_policy, make_world_model

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "goal": {"low": [0.0, 0.0], "high": [1.0, 1.0]},
    "position": {"low": [0.0] * 6, "high": [1.0] * 6},
}


def make_actor():
    torch.manual_seed(0)
    model = make_world_model(CONSTANTS, ("position",), latent_size=16, hidden_size=24)
    return Actor(model, make_policy(CONSTANTS, "feedforward", model, width=16))


def test_an_episode_does_not_depend_on_the_others_in_its_batch():
    actor, seeds = make_actor(), scene_seeds("validation", 3)
    together = roll_out(actor, "balance_reaching", seeds)
    alone = roll_out(actor, "balance_reaching", seeds[1:2])
    torch.testing.assert_close(together["action"][1], alone["action"][0], rtol=1e-3, atol=1e-5)
    assert together.shape == (3, EPISODE_STEPS)


def test_rows_say_what_happened():
    actor, seeds = make_actor(), scene_seeds("validation", 3)
    episodes = roll_out(actor, "balance_reaching", seeds)
    rows = episode_rows(episodes, seeds)
    distance = (episodes["dynamics", "position"][..., :2] - episodes["goal"]).norm(dim=-1)
    for i, row in enumerate(rows):
        assert row["scene_seed"] == seeds[i]
        # the mean over the last ten observations; the rollout holds all but the very last
        assert abs(row["position_error"] - distance[i, -9:].mean()) < 0.01
        assert row["success"] == (not row["dropped"] and row["position_error"] < 0.05)
        assert row["localization_error"] > 0


def test_both_protocols_on_their_own_scenes():
    actor = make_actor()
    result = evaluate(actor.world_model, actor.policy, "balance_reaching", test_episodes=3, paper_episodes=2)
    test, paper = (set(result[name]["rows"]["scene_seed"]) for name in ("test", "paper"))
    assert (len(test), len(paper), test & paper) == (3, 2, set())
    assert result["test"]["summary"]["episodes"] == 3
    train = set(scene_seeds("train", 100_000)) | set(scene_seeds("eval", 100_000))
    assert not (test | paper) & train
