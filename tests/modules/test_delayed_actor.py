"""Delayed actor: late, lost and disordered frames against frames in time."""

import pytest
import torch
from small import CONSTANTS, make_model
from tensordict import TensorDict

from dynmap_rl.modules.actor import MEMORY, Actor
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.delayed_actor import DelayedActor

T = 9
CLOSE = {"rtol": 1e-4, "atol": 1e-5}
GOAL = torch.tensor([[0.3, 0.6], [0.7, 0.2]])
both_kinds = pytest.mark.parametrize("kind", ["feedforward", "recurrent"])


def make_actor(kind="recurrent"):
    model = make_model()
    return Actor(model, make_policy(CONSTANTS, kind, model, width=20)).eval()


def make_frames():
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (2, T, 3, 64, 64), dtype=torch.uint8, generator=generator)


def run(actor, arrivals, actions=None):
    """Return the steps of two episodes: ``arrivals`` has the entries of each, ``actions`` replace the policy's."""
    memory, steps = TensorDict({}, [2]), []
    for t, entries in enumerate(arrivals):
        td = actor.act(actor.observe(memory.clone().update({"goal": GOAL, **entries})))
        if actions is not None:
            td["action"] = actions[:, t]
        memory = actor.predict(td)["next"]
        keys = ["action", "latent", "next", *(["hidden1", "hidden2"] if "history" in td.keys() else [])]
        steps.append(td.select(*keys))
    return torch.stack(steps, 1)


def send(frames, schedule, places=None):
    """Return the entries of each step: those of ``schedule[t]`` are the steps of the frames that arrive at t."""
    places, arrivals = places or max(map(len, schedule)), []
    for t, taken in enumerate(schedule):
        delay = torch.full((2, places), -1)
        pixels = torch.full((2, places, 3, 64, 64), 99, dtype=torch.uint8)
        for place, s in enumerate(taken):
            pixels[:, place], delay[:, place] = frames[:, s], t - s
        arrivals.append({"pixels": pixels, "delay": delay})
    return arrivals


@both_kinds
@pytest.mark.parametrize("max_delay", [0, 3])
@torch.no_grad()
def test_without_delay_it_is_exactly_the_actor(kind, max_delay):
    actor, frames = make_actor(kind), make_frames()
    in_time = [{"pixels": frames[:, t]} for t in range(T)]
    expected, out = run(actor, in_time), run(DelayedActor(actor, max_delay=max_delay), in_time)
    for key in ("action", "latent", ("next", "predicted_latent"), *(("next", key) for key in MEMORY)):
        assert torch.equal(out[key], expected[key]), key
    assert torch.equal(out["hidden2"][:, 1:], expected["next", "hidden2"][:, :-1])


@both_kinds
@torch.no_grad()
def test_it_filters_up_to_the_last_frame_and_imagines_the_rest(kind):
    """The definition, step by step: a fixed delay, each frame with its own action, the policy with its own memory."""
    actor, frames, delay = make_actor(kind), make_frames(), 3
    out = run(DelayedActor(actor, delay), [{"pixels": frames[:, max(t - delay, 0)]} for t in range(T)])
    model, memory = actor.world_model, actor.policy.initial_state(2)
    latent = model.encode(frames)
    for t in range(T):
        z, state = latent[:, 0], model.initial_state(2)
        for s in range(t):
            z, state = model.step(latent[:, s] if s <= t - delay else z, out["action"][:, s], state)
        action, memory = actor.policy.step(z, state[0], state[2], GOAL, memory)
        for key, value in {"latent": z, "hidden1": state[0], "hidden2": state[2], "action": action}.items():
            torch.testing.assert_close(out[key][:, t], value, **CLOSE)


@torch.no_grad()
def test_with_a_perfect_world_model_delay_changes_nothing(monkeypatch):
    """In a world that the model predicts without error, late and lost frames hold nothing new."""
    actor, model = make_actor(), make_model()
    monkeypatch.setattr(actor.world_model, "encode", lambda pixels, mixed: pixels[..., 0, 0, :16])

    def live(actor, delays):
        latent, state = torch.randn(2, 16, generator=torch.Generator().manual_seed(2)), model.initial_state(2)
        memory, frames, actions = TensorDict({}, [2]), [], []
        for t, delay in enumerate(delays):
            frames.append(latent[:, None, None].expand(2, 3, 64, 16))
            td = memory.set("goal", GOAL)
            if delay is not None:
                td["pixels"], td["delay"] = frames[t - delay], torch.full((2, 1), delay)
            actions.append(actor(td)["action"])
            latent, state = model.step(latent, td["action"], state)
            memory = td["next"]
        return torch.stack(actions, 1)

    delayed = DelayedActor(actor, max_delay=4)
    late = live(delayed, [0, 1, 2, 3, None, 4, 2, None, 4])
    torch.testing.assert_close(late, live(actor, [0] * T), **CLOSE)


SCHEDULES = {
    "late": [[0], [], [1], [2], [3], [4], [5], [6], [7, 8]],
    "bursts": [[0], [], [], [1, 2, 3], [], [], [4, 5, 6], [], [7, 8]],
    "disorder": [[0], [], [2], [1], [], [5, 3], [6], [4], [8, 7]],
    "twice": [[0], [0, 1], [1, 2], [3, 2], [4], [5, 3], [6], [7, 6], [8]],
}


@pytest.mark.parametrize("name", SCHEDULES)
@torch.no_grad()
def test_once_all_frames_have_arrived_their_way_does_not_matter(name):
    actor, frames = make_actor(), make_frames()
    actions = 0.01 * torch.randn(2, T, 3, generator=torch.Generator().manual_seed(1))
    in_time = run(DelayedActor(actor, max_delay=4), send(frames, [[t] for t in range(T)]), actions)
    out = run(DelayedActor(actor, max_delay=4), send(frames, SCHEDULES[name]), actions)
    assert name == "twice" or not torch.allclose(out["latent"][:, 4], in_time["latent"][:, 4])
    for key in ("latent", "hidden1", "hidden2"):
        torch.testing.assert_close(out[key][:, -1], in_time[key][:, -1], **CLOSE)


@torch.no_grad()
def test_of_several_frames_of_one_step_the_last_is_used():
    actor, frames = DelayedActor(make_actor(), max_delay=2), make_frames()
    entries = {"pixels": frames[:, :2], "delay": torch.zeros(2, 2, dtype=torch.int64)}
    latent = run(actor, [entries])["latent"][:, 0]
    torch.testing.assert_close(latent, actor.world_model.encode(frames[:, 1]))
    assert not torch.allclose(latent, actor.world_model.encode(frames[:, 0]))


@torch.no_grad()
def test_frames_that_are_too_late_or_of_another_episode_are_lost():
    actor, frames = make_actor(), make_frames()
    lost = run(DelayedActor(actor, max_delay=2), send(frames, [[0], [], [], [2], [], [4], [], [], []]))
    entries = send(frames, [[0], [], [], [2], [1], [4], [], [], [5]])  # delays of 3
    entries[1] = {"pixels": frames[:, 5], "delay": torch.full((2, 1), 2)}  # taken before the first step
    assert torch.equal(run(DelayedActor(actor, max_delay=2), entries)["action"], lost["action"])
    no_entries = send(frames, [[0], [], [], [2], [], [4], [], [], []])
    no_entries[-3:] = [{}] * 3
    assert torch.equal(run(DelayedActor(actor, max_delay=2), no_entries)["action"], lost["action"])


@torch.no_grad()
def test_a_world_alone_acts_as_in_a_batch():
    actor, frames = DelayedActor(make_actor(), max_delay=4), make_frames()
    arrivals = send(frames, SCHEDULES["disorder"])
    late = send(frames, SCHEDULES["bursts"], places=2 + 1)
    for entries, others in zip(arrivals, late, strict=True):  # the second world has delays of its own
        pixels, delay = others["pixels"].clone(), others["delay"].clone()
        pixels[0, :2], delay[0, :2], delay[0, 2] = entries["pixels"][0], entries["delay"][0], -1
        entries.update(pixels=pixels, delay=delay)
    together = run(actor, arrivals)["action"]
    for world in range(2):
        memory = TensorDict()  # without a batch axis
        for t, entries in enumerate(arrivals):
            td = memory.update({key: value[world] for key, value in entries.items()}).set("goal", GOAL[world])
            memory = actor(td)["next"]
            torch.testing.assert_close(td["action"], together[world, t], rtol=1e-3, atol=1e-5)


@torch.no_grad()
def test_history_is_cleared_where_an_episode_begins():
    actor, frames = DelayedActor(make_actor(), max_delay=3), make_frames()
    memory = run(actor, send(frames, [[0], [1], [], [2]]))[:, -1]["next"]
    entries = {"goal": GOAL, "pixels": frames[:, 5], "delay": torch.zeros(2, 1, dtype=torch.int64)}
    begins = torch.tensor([[True], [False]])
    out, fresh = (actor(td.update(entries)) for td in (memory.set("is_init", begins), TensorDict({}, [2])))
    for key in ("action", ("next", "hidden2"), ("next", "history", "latent"), ("next", "history", "step")):
        assert torch.equal(out[key][0], fresh[key][0])
        assert not torch.equal(out[key][1], fresh[key][1]), key


@torch.no_grad()
def test_a_call_leaves_the_history_that_it_reads():
    actor, frames = DelayedActor(make_actor(), max_delay=3), make_frames()
    memory = run(actor, send(frames, [[0], [1], [], [2]]))[:, -1]["next"]
    kept = memory["history"].clone()
    entries = {"goal": GOAL, "pixels": frames[:, 5], "delay": torch.ones(2, 1, dtype=torch.int64)}
    actor(memory.copy().update(entries))
    assert (memory["history"] == kept).all()


def test_keys_are_those_of_the_actor():
    plain, frames = make_actor(), make_frames()
    keys = {
        "pixels": ("camera", "front"),
        "action": ("agent", "move"),
        "memory": tuple(("m", k) for k in MEMORY),
    }
    actor = Actor(plain.world_model, plain.policy, latent=("m", "z"), **keys)
    actor = DelayedActor(actor, 2, delay_key=("camera", "delay"), history=("m", "history"))
    td = TensorDict({("camera", "front"): frames[:, 0], "goal": GOAL}, [2])
    td["camera", "delay"] = torch.zeros(2, 1, dtype=torch.int64)
    out = actor(td)
    expected = plain(TensorDict({"pixels": frames[:, 0], "goal": GOAL}, [2]))
    assert torch.equal(out["agent", "move"], expected["action"])
    assert set(actor.out_keys) <= set(out.keys(True, True))
    assert {key for key in out["next"].keys(True, True) if "history" in key} == {
        key for key in actor.make_tensordict_primer().primers.keys(True, True) if "history" in key
    }


@torch.no_grad()
def test_gradients_pass_through_the_imagined_steps():
    actor, frames = make_actor("feedforward"), make_frames()
    with torch.enable_grad():
        out = run(DelayedActor(actor, 3), [{"pixels": frames[:, max(t - 3, 0)]} for t in range(5)])
        out["action"][:, -1].sum().backward()
    assert actor.world_model.transition.change.weight.grad.abs().sum() > 0
    assert all(p.grad.abs().sum() > 0 for p in actor.policy.parameters())


@pytest.mark.parametrize("arguments", [(-1,), (3, 2)])
def test_bad_delays_are_refused(arguments):
    with pytest.raises(ValueError, match="delay must be between 0 and max_delay"):
        DelayedActor(make_actor(), *arguments)


@pytest.mark.parametrize(
    ("frames", "delays"), [((2, 5), (2, 1)), ((2,), (2, 5)), ((2, 5), None)], ids=["few", "many", "none"]
)
def test_every_frame_needs_a_delay(frames, delays):
    td = TensorDict({"goal": GOAL, "pixels": torch.zeros(*frames, 3, 64, 64, dtype=torch.uint8)}, [2])
    if delays:
        td["delay"] = torch.zeros(delays, dtype=torch.int64)
    with pytest.raises(ValueError, match="a delay for each frame"):
        DelayedActor(make_actor(), max_delay=3)(td)


def test_delays_are_whole_steps():
    td = TensorDict({"goal": GOAL, "pixels": torch.zeros(2, 3, 64, 64, dtype=torch.uint8)}, [2])
    with pytest.raises(ValueError, match="int64"):
        DelayedActor(make_actor(), max_delay=3)(td.set("delay", torch.zeros(2, 1)))
    with pytest.raises(ValueError, match="whole"):
        DelayedActor(make_actor(), delay=1.5)


@torch.no_grad()
def test_every_world_must_begin_with_a_frame_of_its_first_step():
    frames = make_frames()
    for delays in ([1, 1], [0, -1], [-1, -1]):
        td = TensorDict({"goal": GOAL, "pixels": frames[:, 0], "delay": torch.tensor(delays)[:, None]}, [2])
        with pytest.raises(KeyError, match="must begin with a frame"):
            DelayedActor(make_actor(), max_delay=4)(td)
    actor = DelayedActor(make_actor(), max_delay=4)
    begun = actor(TensorDict({"goal": GOAL, "pixels": frames[:, 0]}, [2]))["next"].copy()
    begun.update({"goal": GOAL, "is_init": torch.tensor([[False], [True]])})
    with pytest.raises(KeyError, match="must begin with a frame"):
        actor(begun)


@torch.no_grad()
def test_a_compiled_actor_remembers_what_it_has_seen():
    """Its first call has no memory in the TensorDict."""
    for actor in (make_actor(), DelayedActor(make_actor(), max_delay=2)):
        results = []
        for function in (actor, torch.compile(actor, backend="eager")):
            td = TensorDict({}, [2])
            for t in range(3):
                td = function(td.copy().update({"goal": GOAL, "pixels": make_frames()[:, t]}))["next"]
            results.append(td)
        torch.testing.assert_close(results[0]["hidden1"], results[1]["hidden1"])
        torch.testing.assert_close(results[0]["policy_hidden1"], results[1]["policy_hidden1"])
