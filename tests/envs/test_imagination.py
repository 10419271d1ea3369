"""The world model as an environment, against its own step form."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, RenameTransform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from dynmap_rl.envs.imagination import ImaginationEnv, make_start
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world_model_transform import WorldModelTransform
from dynmap_rl.modules.actor import MEMORY, LatentActor, make_policy_module
from dynmap_rl.modules.checkpoints import make_policy, make_world_model
from dynmap_rl.modules.normalization import Normalizer
from dynmap_rl.modules.world_model import WorldModel

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "goal": {"low": [0.0, 0.0], "high": [1.0, 1.0]},
    **{name: {"low": [0.0] * 6, "high": [1.0] * 6} for name in ("position", "velocity")},
}
B = 3


def make_model(supervision=("position", "velocity")):
    torch.manual_seed(0)
    return make_world_model(CONSTANTS, supervision, latent_size=16, hidden_size=24).eval()


@pytest.fixture
def frames() -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    pixels = torch.randint(0, 256, (B, 4, 3, 64, 64), dtype=torch.uint8, generator=generator)
    action = 0.01 * torch.randn(B, 4, 3, generator=generator)
    goal = torch.rand(B, 1, 2, generator=generator).expand(B, 4, 2)
    return TensorDict({"pixels": pixels, "action": action, "goal": goal}, [B, 4])


@torch.no_grad()
def test_the_start_is_where_the_world_model_is_after_the_frames(frames):
    model, start = make_model(), make_start(make_model(), frames)
    latent = model.encode(frames["pixels"])
    predicted, hidden1, hidden2 = model.predict(latent, frames["action"])
    expected = {"latent": latent, "predicted_latent": predicted, "hidden1": hidden1, "hidden2": hidden2}
    for key, value in expected.items():
        torch.testing.assert_close(start[key], value[:, -1], rtol=1e-5, atol=1e-5)
    assert torch.equal(start["goal"], frames["goal"][:, -1]) and "pixels" not in start
    first = make_start(model, frames[:, :1])
    assert all((first[key] == 0).all() for key in ("predicted_latent", *MEMORY))


def test_the_executed_actions_of_a_rollout_are_read():
    episodes = DynmapBatchedEnv(num_envs=2, from_pixels=True, seed=0).rollout(5)
    executed = (episodes["next", "agent_pos"] - episodes["agent_pos"])[..., :3]
    assert (executed - episodes["action"]).abs().max() > 0.01
    expected = make_start(make_model(), episodes.clone().set("action", executed))
    start = make_start(make_model(), episodes, agent_pos="agent_pos")
    assert set(start.keys()) == set(expected.keys()) and (start == expected).all()


def reward(td):
    return -(td["predicted_dynamics", "position"][:, :2] - td["goal"]).norm(dim=-1, keepdim=True)


@pytest.mark.parametrize(
    "arguments", [{}, {"decode_pixels": True}, {"reward": reward, "decode_pixels": True}], ids=" ".join
)
def test_specs(frames, arguments):
    env = ImaginationEnv(make_model(), make_start(make_model(), frames), **arguments)
    check_env_specs(env)
    assert (("reconstruction", "pixels") in env.rollout(1).keys(True)) is ("decode_pixels" in arguments)
    bare = TensorDict({"latent": torch.zeros(B, 16)}, [B])
    check_env_specs(ImaginationEnv(make_model(()), bare, arguments.get("decode_pixels", False)))


def test_actions_are_those_of_the_world_model():
    action = Normalizer([-1.0, 0.0], [1.0, 0.5])
    model = WorldModel(action, {}, latent_size=16, hidden_size=24)
    env = ImaginationEnv(model, TensorDict({"latent": torch.zeros(B, 16)}, [B]))
    check_env_specs(env)
    assert env.action_spec.shape == (B, 2)
    assert env.action_spec.space.low[0].tolist() == [-1, 0] and env.action_spec.space.high[0].tolist() == [
        1,
        0.5,
    ]


@torch.no_grad()
def test_a_step_feeds_the_prediction_back_and_decodes_it(frames):
    model, start = make_model(), make_start(make_model(), frames)
    out = ImaginationEnv(model, start, decode_pixels=True, reward=reward).rollout(6)
    latent, memory = start["latent"], tuple(start[key] for key in MEMORY)
    for t in range(6):
        latent, memory = model.step(latent, out["action"][:, t], memory)
        after = out[:, t]["next"]
        torch.testing.assert_close(after["latent"], latent)
        torch.testing.assert_close(after["predicted_latent"], latent)
        for key, value in zip(MEMORY, memory, strict=True):
            torch.testing.assert_close(after[key], value)
        states = latent, memory[0], memory[2]
        for quantity, value in model.decode_dynamics(*states).items():
            torch.testing.assert_close(after["predicted_dynamics", quantity], value)
        torch.testing.assert_close(after["reconstruction", "pixels"], model.decode_pixels(*states))
        torch.testing.assert_close(after["reward"], reward(after))
        assert torch.equal(after["goal"], start["goal"]) and not after["done"].any()
    assert torch.equal(out["latent"][:, 1:], out["next", "latent"][:, :-1])


def test_what_torchrl_holds_is_not_imagined_further(frames):
    env = ImaginationEnv(make_model(), make_start(make_model(), frames), reward=reward)
    td = env.reset()
    before = td.clone()
    held = torch.tensor([True, False, True])
    after = env.step(env.rand_action(td).set("_step", held))["next"]
    for key in ("latent", "hidden1", ("predicted_dynamics", "position")):
        torch.testing.assert_close(after[key][1], before[key][1])
        assert not torch.equal(after[key][0], before[key][0])
    assert after["reward"][1] == 0 and after["reward"][0] != 0


def test_no_reward_is_predicted(frames):
    out = ImaginationEnv(make_model(), make_start(make_model(), frames)).rollout(3)
    assert (out["next", "reward"] == 0).all()


def test_resets_go_to_the_start_or_where_they_are_told(frames):
    env = ImaginationEnv(make_model(), make_start(make_model(), frames))
    start = env.reset()
    td = env.rollout(4)[:, -1]["next"].exclude("reward")
    part = env.reset(td.clone().set("_reset", torch.tensor([[True], [False], [False]])), set_state=False)
    assert torch.equal(part["latent"][0], start["latent"][0])
    assert torch.equal(part["latent"][1:], td["latent"][1:])
    elsewhere = make_start(make_model(), frames[:, :2])
    assert torch.equal(env.reset(elsewhere.clone(), set_state=True)["hidden2"], elsewhere["hidden2"])
    assert torch.equal(env.reset()["hidden2"], start["hidden2"])


@torch.no_grad()
def test_worlds_of_a_rollout_are_reset_one_by_one(frames):
    env = TransformedEnv(ImaginationEnv(make_model(), make_start(make_model(), frames)), InitTracker())
    first = env.reset()
    last = env.rollout(3)[:, -1]["next"]
    mask = torch.zeros(*env.batch_size, 1, dtype=torch.bool)
    mask[0] = True
    td = env.reset(last.clone().set("_reset", mask))
    for key in ("latent", "hidden1"):
        assert torch.equal(td[key][0], first[key][0]) and torch.equal(td[key][1:], last[key][1:])
    assert torch.equal(td["is_init"], mask)


@pytest.mark.parametrize("kind", ["feedforward", "recurrent"])
def test_policies_act_in_it(frames, kind):
    model = make_model()
    actor = LatentActor(make_policy(CONSTANTS, kind, model, width=20))
    env = ImaginationEnv(model, make_start(model, frames), reward=reward)
    env = TransformedEnv(env, Compose(InitTracker(), actor.make_tensordict_primer()))
    check_env_specs(env)
    with torch.no_grad():
        out = env.rollout(7, actor)
    assert out.shape == (B, 7) and not out["is_init"][:, 1:].any()
    sequence = make_policy_module(actor.policy)(out.select("latent", "hidden1", "hidden2", "goal"))
    torch.testing.assert_close(out["action"], sequence["action"], rtol=1e-3, atol=1e-6)
    collector = Collector(env, actor, frames_per_batch=6 * B, total_frames=12 * B)
    assert [batch.shape for batch in collector] == [(B, 6)] * 2
    collector.shutdown()


def test_a_reward_s_gradient_reaches_the_policy_through_the_steps(frames):
    model = make_model()
    actor = LatentActor(make_policy(CONSTANTS, "feedforward", model, width=20))
    out = ImaginationEnv(model, make_start(model, frames), reward=reward).rollout(5, actor)
    out["next", "reward"].sum().backward()
    assert all(p.grad.abs().sum() > 0 for p in actor.policy.parameters())


def test_a_start_of_another_form_is_refused(frames):
    message = r"start must be a TensorDict \[B\] with latent \[B, 16\]"
    env = ImaginationEnv(make_model(), make_start(make_model(), frames))
    for start in (TensorDict({}, [B]), TensorDict({"latent": torch.zeros(B, 9)}, [B])):
        with pytest.raises(ValueError, match=message):
            ImaginationEnv(make_model(), start)
        with pytest.raises(ValueError, match=message):
            env.reset(start, set_state=True)
    with pytest.raises(ValueError, match=message):
        env.reset(set_state=True)


@torch.no_grad()
def test_other_names_by_torchrl_s_own_transform(frames):
    model = make_model()
    env = ImaginationEnv(model, make_start(model, frames))
    names = ["latent", "hidden1", "hidden2"]
    nested, move = [("world", name) for name in names], ("agent", "move")
    renamed = TransformedEnv(env, RenameTransform(names, nested, ["action", *names], [move, *nested]))
    check_env_specs(renamed)
    theirs = renamed.rollout(5, lambda td: td.set(move, 0.01 * torch.tanh(td["world", "latent"][:, :3])))
    ours = env.rollout(5, lambda td: td.set("action", 0.01 * torch.tanh(td["latent"][:, :3])))
    for name, key in zip(names, nested, strict=True):
        assert torch.equal(theirs["next", *key], ours["next", name])


def test_a_step_of_a_rollout_is_a_start():
    transforms = Compose(InitTracker(), WorldModelTransform(make_model()))
    step = TransformedEnv(DynmapBatchedEnv(num_envs=2, from_pixels=True), transforms).rollout(3)[:, -1]
    imagined = ImaginationEnv(make_model(), step)
    check_env_specs(imagined)
    torch.testing.assert_close(imagined.reset()["hidden1"], step["hidden1"])


@torch.no_grad()
def test_a_recurrent_policy_goes_on_with_its_memory_from_a_step_of_a_rollout(frames):
    model = make_model()
    actor = LatentActor(make_policy(CONSTANTS, "recurrent", model, width=20))
    primed = Compose(InitTracker(), actor.make_tensordict_primer())
    out = TransformedEnv(ImaginationEnv(model, make_start(model, frames)), primed).rollout(6, actor)
    rest = ImaginationEnv(model, out[:, 3].exclude("action")).rollout(3, actor)
    torch.testing.assert_close(rest["action"], out["action"][:, 3:], rtol=1e-3, atol=1e-6)


def test_a_start_is_copied(frames):
    model = make_model()
    start = make_start(model, frames)
    env, kept = ImaginationEnv(model, start), start.clone()
    start["latent"].add_(5)
    start["goal"].add_(5)
    assert all(torch.equal(env.reset()[key], kept[key]) for key in ("latent", "goal"))
    td = env.reset(kept, set_state=True)
    td["goal"].add_(5)
    assert torch.equal(kept["goal"], frames["goal"][:, -1])


def test_the_start_moves_with_the_environment(frames):
    env = ImaginationEnv(make_model(), make_start(make_model(), frames))
    env.action_spec = env.observation_spec["latent"].clone()  # bounds cannot be checked without values
    assert env.to("meta") is env and env.start.device == torch.device("meta")


def test_a_reward_of_another_shape_is_refused_and_of_another_type_cast(frames):
    model = make_model()
    with pytest.raises(TypeError, match="function"):
        ImaginationEnv(model, make_start(model, frames), reward=3)
    for shape, fine in (((B,), False), ((B, 1), True)):
        env = ImaginationEnv(
            model, make_start(model, frames), reward=lambda td, s=shape: torch.ones(s).double()
        )
        if fine:
            assert env.rollout(2)["next", "reward"].dtype == torch.float32
        else:
            with pytest.raises(ValueError, match=r"reward must return \[3, 1\]"):
                env.rollout(2)
