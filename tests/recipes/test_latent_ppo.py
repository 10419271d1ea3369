"""PPO on latents: the smoke run, resuming to the same weights, and what is refused."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from dynmap_rl import modules  # MODULE
from dynmap_rl import runs  # MODULE
from dynmap_rl.envs.world import ACCELERATION_LIMIT
from dynmap_rl.evaluation.rollout import roll_out as roll_out_actor
from dynmap_rl.experts.network import ExpertNetwork
from recipes.latent_ppo import Config, main, make_env, roll_out

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "position": {"low": [0.0] * 6, "high": [1.0] * 6},
}
WEIGHTS = "checkpoint/iteration_002.safetensors"


@pytest.fixture(scope="module")
def world_model(tmp_path_factory) -> Path:
    """The run folder of an untrained world model."""
    folder = tmp_path_factory.mktemp("decoupled")
    torch.manual_seed(0)
    model = modules.make_world_model(CONSTANTS, ("position",), latent_size=16, hidden_size=24)
    modules.save_world_model(folder / "world_model", model)
    runs.write_json(
        folder / "eval.json", {"world_model": {"task": "balance_reaching", "training": "decoupled"}}
    )
    return folder


def tiny(run: Path, world_model: Path, **changes) -> Config:
    return Config(smoke=True, run=run, world_model=world_model, threads=1, **changes)


@pytest.fixture(scope="module")
def finished(tmp_path_factory, world_model) -> Path:
    run = tmp_path_factory.mktemp("latent_ppo")
    main(tiny(run, world_model))
    return run


def test_smoke_run_reports_both(finished, world_model, capsys):
    result = runs.read_json(finished / "eval.json")
    assert (result["latents"]["episodes"], result["states"]["episodes"]) == (4, 4)
    assert result["states"]["success"] == 1 and result["states"]["expert"] == "balance_reaching"
    assert 0 <= result["latents"]["success"] <= 1 and 0 <= result["latents"]["drop"] <= 1
    assert result["latents"]["state_size"] == 16 + 2 * 24 + 2
    assert result["world_model_of"] == {"task": "balance_reaching", "training": "decoupled"}
    assert [row["step"] for row in runs.read_metrics(finished)] == [1, 2]
    first, last = (load_file(finished / f"checkpoint/iteration_00{i}.safetensors") for i in (1, 2))
    assert any(not torch.equal(first[k], last[k]) for k in first)
    before = (finished / WEIGHTS).read_bytes()
    main(tiny(finished, world_model))
    printed = capsys.readouterr().out
    assert "is done" in printed and "PPO on latents" in printed and "PPO on states" in printed
    assert (finished / WEIGHTS).read_bytes() == before
    assert "Rollouts in closed loop, failures first" in (finished / "report.html").read_text()


def test_killed_run_resumes_to_the_same_weights(finished, world_model, tmp_path, monkeypatch):
    save = runs.save_training_state

    def kill(path, **state):
        save(path, **state)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(runs, "save_training_state", kill)
        with pytest.raises(KeyboardInterrupt):
            main(tiny(tmp_path, world_model))
    main(tiny(tmp_path, world_model))
    expected, resumed = load_file(finished / WEIGHTS), load_file(tmp_path / WEIGHTS)
    assert all(torch.equal(resumed[k], expected[k]) for k in expected)


def test_what_the_policy_reads_is_what_imitating_policies_read(world_model):
    """The same accelerations as position updates, through the actor of the evaluation: the same latents and memory."""
    model = modules.load_world_model(world_model / "world_model")
    env = make_env(model, "balance_reaching", 2)
    td = env.reset(scene_seed=torch.tensor([3, 4]))
    states, actions = [], []
    for _ in range(120):
        states.append(td["state"])
        assert "pixels" not in td
        td = env.step(td.set("action", torch.full((2, 3), 0.3)))["next"]
        actions.append(torch.tensor([world.action.tolist() for world in env.base_env.worlds]))
    actions = iter(actions)

    class Replay(torch.nn.Module):
        seen = []

        def step(self, latent, hidden1, hidden2, goal, state):
            self.seen.append(torch.cat([latent, hidden1, hidden2, goal], -1))
            return next(actions), state

    replay = Replay()
    roll_out_actor(modules.Actor(model, replay, mixed=True), "balance_reaching", [3, 4])
    for expected, seen in zip(replay.seen, states, strict=True):
        torch.testing.assert_close(seen, expected, rtol=1e-4, atol=1e-4)


def test_evaluation_is_of_the_mean_action_on_the_scenes_given(world_model):
    model = modules.load_world_model(world_model / "world_model")
    torch.manual_seed(0)
    network = ExpertNetwork(16 + 2 * 24 + 2, tuple(ACCELERATION_LIMIT), 8)
    ends = [roll_out(network, model, "balance_reaching", seeds) for seeds in ([7, 8], [8], [9])]
    assert [world.steps for world in ends[0]] == [120, 120]
    assert ends[0][1].position_error == pytest.approx(ends[1][0].position_error, abs=1e-4)
    assert ends[1][0].position_error != pytest.approx(ends[2][0].position_error, abs=1e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"world_model": None}, "--world_model is the run folder"),
        ({"world_model": Path("nowhere")}, "nowhere holds no finished run"),
        ({"task": "juggling"}, "unknown task"),
        ({"expert": "nobody"}, "no expert at nobody"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(world_model, tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        main(Config(**{"world_model": world_model, "run": tmp_path / "bad", "smoke": True} | settings))
    assert not (tmp_path / "bad").exists()
