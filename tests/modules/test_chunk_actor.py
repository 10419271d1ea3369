"""Chunks of actions: by imagination, in turn with frames, and equal to those of a delayed actor."""

import pytest
import torch
from small import CONSTANTS, make_model
from tensordict import TensorDict

from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.chunk_actor import ChunkActor
from dynmap_rl.modules.delayed_actor import DelayedActor

kinds = pytest.mark.parametrize("kind", ["feedforward", "recurrent"])


def make_actor(kind):
    torch.manual_seed(0)
    world_model = make_model()
    return Actor(world_model, make_policy(CONSTANTS, kind, world_model)).eval()


def draw(steps, batch=2):
    generator = torch.Generator().manual_seed(1)
    pixels = torch.randint(256, (steps, batch, 3, 64, 64), dtype=torch.uint8, generator=generator)
    return pixels, torch.rand(batch, 2, generator=generator)


@torch.no_grad()
def continue_without_frames(actor, td, goal, steps):
    """Return the actions of an actor from this step on, of which only the first has a frame."""
    actions = []
    for _ in range(steps):
        td = actor(td.set("goal", goal))
        actions.append(td["action"])
        td = td["next"].copy()
    return torch.stack(actions, 1), td


@kinds
def test_a_chunk_is_the_actor_without_frames(kind):
    actor, (pixels, goal) = make_actor(kind), draw(2)
    chunks = ChunkActor(actor, size=5)
    expected, td = continue_without_frames(actor, TensorDict({"pixels": pixels[0]}, [2]), goal, 5)
    assert torch.equal(chunks.act(pixels[0], goal), expected)
    # The whole chunk is executed before the next frame.
    expected, _ = continue_without_frames(actor, td.set("pixels", pixels[1]), goal, 5)
    assert torch.equal(chunks.act(pixels[1], goal), expected)
    chunks.reset()
    assert torch.equal(chunks.act(pixels[1], goal), chunks.act(pixels[1], goal, step=0))


@kinds
def test_a_frame_may_come_before_the_end_of_a_chunk(kind):
    actor, (pixels, goal) = make_actor(kind), draw(2)
    chunks = ChunkActor(actor, size=5)
    chunks.act(pixels[0], goal, step=0)
    _, td = continue_without_frames(actor, TensorDict({"pixels": pixels[0]}, [2]), goal, 3)
    expected, _ = continue_without_frames(actor, td.set("pixels", pixels[1]), goal, 5)
    assert torch.equal(chunks.act(pixels[1], goal, step=3), expected)
    # The same step once more, as a robot that waits may send a second frame.
    assert torch.equal(chunks.act(pixels[1], goal, step=3), expected)


@kinds
@pytest.mark.parametrize("delay", [0, 1, 3])
@torch.no_grad()
def test_a_chunk_in_every_step_acts_as_a_delayed_actor(kind, delay):
    actor, (pixels, goal) = make_actor(kind), draw(9)
    chunks, delayed = ChunkActor(actor, size=delay + 2, delay=delay), DelayedActor(actor, delay=delay)
    memory, plan = TensorDict({}, [2]), {}
    for t in range(9):
        td = delayed(memory.copy().set("goal", goal).set("pixels", pixels[max(t - delay, 0)]))
        memory = td["next"]
        taken = max(t - delay, 0)
        if t == 0 or taken > 0:  # a new frame
            chunk = chunks.act(pixels[taken], goal, step=taken)
            plan |= {taken + i: chunk[:, i] for i in range(delay if taken else 0, delay + 2)}
        assert torch.allclose(td["action"], plan[t], atol=1e-6)


@kinds
def test_the_first_actions_are_those_that_the_robot_executes_meanwhile(kind):
    actor, (pixels, goal) = make_actor(kind), draw(2)
    chunks = ChunkActor(actor, size=8, delay=3)
    first = chunks.act(pixels[0], goal, step=0)
    second = chunks.act(pixels[1], goal, step=4)
    assert torch.equal(second[:, :3], first[:, 4:7])
    assert not torch.allclose(second[:, 3], first[:, 7])


def test_the_first_step_begins_a_new_episode():
    actor, (pixels, goal) = make_actor("recurrent"), draw(2)
    chunks, fresh = ChunkActor(actor, size=6, delay=3), ChunkActor(actor, size=6, delay=3)
    for step in (0, 2):
        chunks.act(pixels[0], goal, step=step)
    first = fresh.act(pixels[1], goal, step=0)  # its frame is another than in the episode before
    assert torch.equal(chunks.act(pixels[1], goal, step=0), first)
    assert torch.equal(fresh.act(pixels[1], goal, step=0), first), "after an episode of a single call, too"
    with pytest.raises(ValueError, match="must have the batch of the last call"):
        chunks.act(pixels[1, :1], goal[:1], step=1)
    # A robot that waited longer than a chunk goes on with its memory.
    assert not torch.allclose(chunks.act(pixels[1], goal, step=9), first)


def test_a_frame_that_was_overtaken_is_refused():
    """It does not clear the memory."""
    actor, (pixels, goal) = make_actor("recurrent"), draw(3)
    chunks, undisturbed = ChunkActor(actor, size=6), ChunkActor(actor, size=6)
    for actor in (chunks, undisturbed):
        for step in (0, 2):
            actor.act(pixels[0], goal, step=step)
    with pytest.raises(ValueError, match="must not be before 2"):
        chunks.act(pixels[1], goal, step=1)
    assert torch.equal(*(actor.act(pixels[2], goal, step=4) for actor in (chunks, undisturbed)))


def test_a_step_beyond_the_last_chunk_may_be_repeated():
    actor, (pixels, goal) = make_actor("recurrent"), draw(2)
    chunks = ChunkActor(actor, size=5)
    for step in (0, 10):
        last = chunks.act(pixels[0], goal, step=step)
    assert torch.equal(chunks.act(pixels[0], goal, step=10), last)


@pytest.mark.parametrize(("size", "delay"), [(4, 4), (4, -1), (0, 0)])
def test_a_delay_must_be_shorter_than_a_chunk(size, delay):
    with pytest.raises(ValueError, match="delay must be between 0 and size - 1"):
        ChunkActor(make_actor("feedforward"), size, delay)


def test_it_needs_an_actor_without_delays():
    with pytest.raises(TypeError, match="must be an Actor, got DelayedActor"):
        ChunkActor(DelayedActor(make_actor("feedforward")), size=4)
