"""Episodes as a TorchRL replay buffer."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import SliceSampler, TensorDictReplayBuffer, TensorStorage
from torchrl.envs.transforms import NextStateReconstructor
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import BCLoss, TD3BCLoss

from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.data.replay import as_replay_buffer
from dynmap_rl.envs.world_model_transform import WorldModelTransform
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.objectives.world_model import WorldModelLoss

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "position": {"low": [0.0] * 6, "high": [1.0] * 6},
}


@pytest.fixture
def episodes() -> TensorDict:
    """Five episodes of eight steps; every step has its own number."""
    number = torch.arange(40).reshape(5, 8, 1)
    done = number % 8 == 7
    return TensorDict({"number": number, "next": {"done": done}}, [5, 8])


def test_samples_are_windows_of_one_episode_each(episodes):
    buffer = as_replay_buffer(episodes, batch=200, length=3, generator=torch.Generator().manual_seed(0))
    sample = buffer.sample()
    assert sample.shape == (200, 3)
    number = sample["number"].squeeze(-1)
    assert (number.diff(dim=1) == 1).all()
    assert (number // 8 == sample["trajectory"]).all()
    assert set(number[:, 0].tolist()) == {8 * e + t for e in range(5) for t in range(6)}, "every place"
    assert torch.equal(sample["next", "done"], number.unsqueeze(-1) % 8 == 7)


def test_rows_with_more_than_one_episode_are_refused(episodes):
    episodes["next", "done"][2, 4] = True
    with pytest.raises(ValueError, match="one episode"):
        as_replay_buffer(episodes, batch=2, length=3)


def test_sampling_again_and_whole_episodes(episodes):
    buffer = as_replay_buffer(episodes, batch=2, length=8)
    for _ in range(3):
        number = buffer.sample()["number"].squeeze(-1)
        assert (number % 8 == torch.arange(8)).all()
    assert set(episodes.keys()) == {"number", "next"}, "the episodes are left as they are"
    with pytest.raises(ValueError, match="8 steps.* got 9"):
        as_replay_buffer(episodes, batch=2, length=9)


def test_the_generator_decides(episodes):
    def draw(seed):
        return as_replay_buffer(episodes, 16, 3, torch.Generator().manual_seed(seed)).sample()["number"]

    assert torch.equal(draw(0), draw(0)) and not torch.equal(draw(0), draw(1))


def test_demonstrations_feed_a_loss_and_a_world_model(recording):
    episodes = load_dataset(recording, "train")
    model = make_world_model(CONSTANTS, ("position",), latent_size=16, hidden_size=24)
    buffer = as_replay_buffer(episodes, batch=2, length=5)
    assert WorldModelLoss(model)(buffer.sample())["loss_rgb"] > 0
    buffer.append_transform(WorldModelTransform(model))
    sample = buffer.sample()
    assert sample["latent"].shape == (2, 5, 16) and sample["hidden2"].shape == (2, 5, 24)
    row, time = sample["index"][1].long() // 120, sample["index"][1].long() % 120
    assert torch.equal(episodes["pixels"][row, time], sample["pixels"][1])


@pytest.mark.filterwarnings("ignore")
def test_torchrls_own_buffer_and_losses_take_loaded_episodes(recording):
    episodes, observed = load_dataset(recording, "train"), ["agent_pos", ("dynamics", "velocity")]
    rows = TensorStorage(episodes.reshape(-1))
    sample = TensorDictReplayBuffer(storage=rows, sampler=SliceSampler(slice_len=10), batch_size=200).sample()
    windows = sample.reshape(20, 10)
    assert (windows["step_count"].diff(dim=1) == 1).all()
    assert (windows["episode"] == windows["episode"][:, :1]).all()

    follow = NextStateReconstructor(observed, traj_key="episode", step_count_key="step_count")
    sampler = SliceSampler(slice_len=10)
    sample = TensorDictReplayBuffer(storage=rows, sampler=sampler, batch_size=200, transform=follow).sample()
    sample = sample[sample["next", "agent_pos"].isfinite().all(-1)]  # without the ends of the slices
    assert 180 <= len(sample) < 200  # a slice may happen to begin where the one before it ends
    place = sample["episode"], sample["step_count"][:, 0] + 1
    for key in observed:
        expected = episodes[key][place]
        assert torch.equal(sample["next"][key], expected)

    actor = TensorDictModule(MLP(5, 3, num_cells=[16]), ["agent_pos"], ["action"])
    critic = ValueOperator(MLP(8, 1, num_cells=[16]), in_keys=["agent_pos", "action"])
    loss = TD3BCLoss(actor, critic, bounds=(-0.05, 0.05))
    losses = loss(sample)
    assert all(losses[name].isfinite() for name in ("loss_actor", "loss_qvalue"))
    assert BCLoss(actor)(sample)["loss_bc"].isfinite()


def test_episodes_have_two_axes_and_are_not_overwritten(episodes):
    with pytest.raises(ValueError, match=r"\[E, T\]"):
        as_replay_buffer(episodes.reshape(-1), 2, 3)
    with pytest.raises(RuntimeError):
        as_replay_buffer(episodes, 2, 3).extend(episodes.reshape(-1))
