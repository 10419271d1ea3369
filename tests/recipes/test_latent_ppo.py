"""PPO on latents: results, the policy's inputs, and what is refused."""

from pathlib import Path

import pytest
import torch
from commands import PRESETS, run, run_small
from safetensors.torch import load_file
from small import CONSTANTS

from dynmap_rl.envs.world import ACCELERATION_LIMIT
from dynmap_rl.evaluation.rollout import roll_out as roll_out_actor
from dynmap_rl.experts.network import ExpertNetwork
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import load_world_model, make_world_model, save_world_model
from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.utils.files import read_json, write_json
from recipes.latent_ppo import make_env, roll_out

WEIGHTS = "checkpoint/iteration_002.safetensors"


@pytest.fixture(scope="module")
def world_model(tmp_path_factory) -> Path:
    """Return the run folder of a small, untrained world model."""
    folder = tmp_path_factory.mktemp("decoupled")
    torch.manual_seed(0)
    model = make_world_model(CONSTANTS, ("position",), latent_size=16, hidden_size=24)
    save_world_model(folder / "world_model", model)
    write_json(folder / "eval.json", {"world_model": {"task": "balance_reaching", "training": "decoupled"}})
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory, world_model):
    folder = tmp_path_factory.mktemp("latent_ppo")
    return folder, run_small(folder, "latent_ppo", "--pretrained", world_model, "--run", "run")


@pytest.mark.slow
def test_a_run_compares_both(finished, world_model):
    folder, printed = finished
    result = read_json(folder / "run/eval.json")
    assert (result["latents"]["episodes"], result["states"]["episodes"]) == (4, 4)
    assert result["states"]["success"] == 1 and result["states"]["expert"] == "balance_reaching"
    assert result["latents"]["state_size"] == 16 + 2 * 24 + 2
    assert result["world_model_of"] == {"task": "balance_reaching", "training": "decoupled"}
    assert [row["step"] for row in read_metrics(folder / "run")] == [1, 2]
    first, last = (load_file(folder / f"run/checkpoint/iteration_00{i}.safetensors") for i in (1, 2))
    assert any(not torch.equal(first[k], last[k]) for k in first)
    assert (folder / "run/report.html").exists()
    before = (folder / "run" / WEIGHTS).stat().st_mtime_ns
    again = run_small(folder, "latent_ppo", "--pretrained", world_model, "--run", "run")
    assert "complete" in again.stdout and printed.stdout.splitlines()[-2] in again.stdout
    assert (folder / "run" / WEIGHTS).stat().st_mtime_ns == before
    torch.manual_seed(1)
    other = make_world_model(CONSTANTS, ("position",), latent_size=16, hidden_size=24)
    save_world_model(world_model / "world_model", other)  # trained again
    for _ in range(2):  # a finished run, and one that resumes
        preset = "--config_path", PRESETS / "latent_ppo.yaml"
        changed = run(folder, "latent_ppo", *preset, "--pretrained", world_model, "--run", "run")
        assert changed.returncode == 2 and "another world model" in changed.stderr
        (folder / "run/eval.json").unlink(missing_ok=True)


def test_what_the_policy_reads_is_what_imitating_policies_read(world_model):
    """The same accelerations, as position updates of the evaluation's actor, give the same latents and memory."""
    model = load_world_model(world_model / "world_model")
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

        def forward(self, latent, hidden1, hidden2, goal):
            self.seen.append(torch.cat([latent, hidden1, hidden2, goal], -1))
            return next(actions)

    replay = Replay()
    roll_out_actor(Actor(model, replay, mixed=True), "balance_reaching", [3, 4])
    for expected, seen in zip(replay.seen, states, strict=True):
        torch.testing.assert_close(seen, expected, rtol=1e-4, atol=1e-4)


def test_evaluation_is_of_the_mean_action_on_the_scenes_given(world_model):
    model = load_world_model(world_model / "world_model")
    torch.manual_seed(0)
    network = ExpertNetwork(16 + 2 * 24 + 2, tuple(ACCELERATION_LIMIT), 8)
    ends = [roll_out(network, model, "balance_reaching", seeds) for seeds in ([7, 8], [8], [9])]
    assert [world.steps for world in ends[0]] == [120, 120]
    assert ends[0][1].position_error == pytest.approx(ends[1][0].position_error, abs=1e-4)
    assert ends[1][0].position_error != pytest.approx(ends[2][0].position_error, abs=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--pretrained"),
        (["--pretrained", "nowhere"], "nowhere holds no finished run"),
        (["--pretrained", "balance_reaching", "--task", "juggling"], "juggling"),
        (["--pretrained", "balance_reaching", "--expert", "nobody"], "nobody"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(tmp_path, arguments, message):
    result = run(tmp_path, "latent_ppo", *arguments)
    assert result.returncode == 2 and message in result.stderr
    assert not any(tmp_path.iterdir())
