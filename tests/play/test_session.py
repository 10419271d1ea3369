"""Drivers of a session and the world model's predictions, without a window."""

import numpy as np
import pytest
import torch
from small import CONSTANTS, make_model
from tensordict import TensorDict

from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.tasks import TASKS, BalanceReaching
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.evaluation.rollout import roll_out
from dynmap_rl.modules.actor import MEMORY, Actor
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.delayed_actor import DelayedActor
from dynmap_rl.play.session import Person, Session


@pytest.fixture(scope="module")
def actor():
    world_model = make_model().eval()
    return Actor(world_model, make_policy(CONSTANTS, "recurrent", world_model, width=16).eval())


@pytest.mark.parametrize("task", TASKS)
def test_the_expert_succeeds_and_its_episode_is_a_demonstration(task):
    session = Session(task)
    session.driver = "expert"
    while not session.over:
        session.step()
    session.step()  # does nothing, as the episode is over
    assert session.succeeded and session.drove == {"expert"}
    episode = session.episode()
    assert episode.shape == (1, 120)
    assert episode["pixels"].shape == (1, 120, 3, 64, 64)
    # The same actions give the same episode.
    env = DynmapBatchedEnv(task, 1)
    td = env.reset(TensorDict({"scene_seed": torch.tensor([session.scene_seed])}, [1]))
    for t in range(120):
        assert torch.equal(td["dynamics", "position"], episode["dynamics", "position"][:, t])
        td = env.step(td.set("action", episode["action"][:, t]))["next"]


def test_a_demonstrator_plans_anew_where_it_takes_over(monkeypatch):
    begun = []

    def demonstrator(task, world):
        begun.append(world.steps)
        return lambda: np.zeros(3)

    monkeypatch.setattr(BalanceReaching, "demonstrator", demonstrator)
    session = Session("balance_reaching")
    for driver in ("expert", "expert", "person", "expert", "expert"):
        session.driver = driver
        session.step()
    assert begun == [0, 3]


def test_a_policy_drives_as_in_its_evaluation(actor):
    session = Session("balance_reaching", actor, seed=3)
    assert session.driver == "policy"
    for _ in range(30):
        session.step()
    expected = roll_out(actor, "balance_reaching", [scene_seed("validation", 3)])[:, :30]
    found = session.episode()
    torch.testing.assert_close(found["dynamics", "position"], expected["dynamics", "position"])
    predicted = np.stack(session.trace["position", "predicted"])
    assert np.isnan(predicted[0]).all()
    reference = expected["predicted_dynamics", "position"][0].numpy()
    np.testing.assert_allclose(predicted[1:30], reference[1:], atol=1e-5)


def test_on_late_frames_the_policy_acts_on_the_predicted_present(actor):
    session = Session("balance_reaching", actor, seed=3, delay=4)
    for _ in range(12):
        session.step()
    late = FrameDelay(4)
    expected = roll_out(DelayedActor(actor, 4), "balance_reaching", [scene_seed("validation", 3)], delay=late)
    found = session.episode()
    torch.testing.assert_close(found["dynamics", "position"], expected["dynamics", "position"][:, :12])
    reference = expected["predicted_dynamics", "position"][0].numpy()
    np.testing.assert_allclose(session.prediction["position"], reference[12], atol=1e-5)
    session.set_delay(100)
    assert session.delay == 20 and session.world.steps == 0 and session.seed == 3


@pytest.mark.parametrize("driver", ["expert", "policy"])
@torch.no_grad()
def test_imagination_continues_without_frames(actor, driver):
    looking, blind = Session("balance_reaching", actor), Session("balance_reaching", actor)
    for session in (looking, blind):
        session.driver = driver
        for _ in range(5):
            session.step()
    blind.imagining = True
    blind.td["pixels"] = torch.zeros_like(blind.td["pixels"])  # not encoded
    memory, world_model = blind.memory.clone(), actor.world_model
    action = torch.as_tensor(blind._expert_action(), dtype=torch.float32)[None]
    if driver == "policy":
        action = actor(memory.clone().set("goal", blind.td["goal"]))["action"]
    predicted, state = world_model.step(
        memory["predicted_latent"], action, tuple(memory[key] for key in MEMORY)
    )
    expected = world_model.decode_dynamics(predicted, state[0], state[2])["position"][0]
    for session in (looking, blind):
        session.step()
    np.testing.assert_allclose(blind.prediction["position"], expected.numpy(), atol=1e-5)
    torch.testing.assert_close(blind.memory["predicted_latent"], predicted)
    assert not np.allclose(looking.prediction["position"], blind.prediction["position"])


def test_imagination_from_the_first_step_begins_with_a_frame(actor):
    plain, imagining = Session("balance_reaching", actor), Session("balance_reaching", actor)
    imagining.imagining = True
    for session in (plain, imagining):
        session.step()
    for key in ("predicted_latent", *MEMORY):
        assert torch.equal(plain.memory[key], imagining.memory[key])


def test_the_person_goes_where_it_points_and_stops_there():
    session = Session("balance_reaching", seed=1)
    session.driver = "person"
    session.person.target = (0.6, 0.4)
    for _ in range(110):
        session.step()
    assert np.abs(session.world.position[:2] - (0.6, 0.4)).max() < 0.01
    assert np.abs(session.world.velocity[:2]).max() < 0.02
    assert not session.world.dropped


def test_keys_move_at_the_limit_of_speed():
    person, action = Person(), np.zeros(3)
    person.direction = np.array([1.0, 0.0, -1.0])
    for _ in range(40):
        action = person.action(np.zeros(3), action)
    np.testing.assert_allclose(action, [0.04, 0, -0.1])


def test_the_next_scene_begins_anew(actor):
    session = Session("balance_reaching", actor)
    first = session.scene_seed
    for _ in range(3):
        session.step()
    session.imagining = True
    session.restart()
    assert session.scene_seed == first + 1 and not session.imagining
    assert (session.world.steps, session.steps, session.prediction, session.drove) == (0, [], {}, set())
    assert session.memory.is_empty()
    assert len(session.trace["velocity", "true"]) == 1
