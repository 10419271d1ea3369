"""Substeps have the same bits as a loop over ``space.step``, for one world and for many at once."""

import numpy as np
import pytest

from dynmap_rl.envs import world
from dynmap_rl.envs.substeps import read_bodies
from dynmap_rl.envs.tasks import TASKS

RANDOM = (0.01, 0.01, 0.03)  # scale of actions at which blocks tip and touch walls


def step_spaces(worlds, before, after, steps, dt):
    """Reference for ``run_substeps``: PyMunk's public interface only."""
    for (space, cart, _), b, a in zip(worlds, before, after, strict=True):
        for i in range(steps):
            *cart.velocity, cart.angular_velocity = (b + (a - b) * ((i + 0.5) / steps)).tolist()
            space.step(dt)
        *cart.velocity, cart.angular_velocity = a.tolist()
    return np.array([read_bodies(cart, block) for _, cart, block in worlds])


def states(worlds):
    """Everything that a control step changes, arrays as bytes."""
    arrays = "position", "velocity", "acceleration", "commanded", "action"
    others = "block_in_cart", "steps", "dropped", "touched", "errors"
    return [
        [*(getattr(w, name).tobytes() for name in arrays), *(getattr(w, name) for name in others)]
        for w in worlds
    ]


@pytest.mark.parametrize("name", TASKS)
def test_substeps_equal_space_step(name, monkeypatch):
    task, count = TASKS[name], 12
    scenes = [task.sample_scene(np.random.default_rng(seed)) for seed in range(count)]
    together, alone, reference = ([task.make_world(scene) for scene in scenes] for _ in range(3))
    rng = np.random.default_rng(0)
    for _ in range(100):
        actions = rng.normal(size=(count, 3)) * RANDOM
        world.step_worlds(together, actions)
        for simulated, action in zip(alone, actions, strict=True):
            simulated.step(action)
        with monkeypatch.context() as patch:
            patch.setattr(world, "run_substeps", step_spaces)
            world.step_worlds(reference, actions)
        assert states(together) == states(alone) == states(reference)
    # The comparison includes contacts that break and callbacks; task 1 has no walls.
    assert any(w.dropped for w in reference)
    assert any(w.touched for w in reference) or name == "balance_reaching"


def test_callbacks_may_remove_shapes():
    simulated = TASKS["bin_dropping"].make_world(TASKS["bin_dropping"].sample_scene(np.random.default_rng(0)))
    space, [shape] = simulated.space, simulated.block.shapes
    space.on_collision(
        world.CART,
        world.BLOCK,
        begin=lambda arbiter, space, _: space.remove(shape) if shape in space.shapes else None,
    )
    simulated.step(np.zeros(3))
    assert shape not in space.shapes
    for _ in range(10):
        simulated.step(np.zeros(3))
    assert simulated.position[4] < simulated.position[1]  # it fell through the cart
