"""The compiled substeps are the plain loop, bit by bit, and the plain loop stands in where they cannot be compiled."""

import builtins
import multiprocessing
import sys

import numpy as np
import pytest

from dynmap_rl.envs import substeps  # MODULE
from dynmap_rl.envs import world  # MODULE
from dynmap_rl.envs.tasks import TASKS


def trajectory(task, monkeypatch, run, seed):
    """What a world gives under random, jerky actions, tipping and touching included."""
    monkeypatch.setattr(world, "choose_run", lambda: run)
    rng = np.random.default_rng(seed)
    simulated = task.make_world(task.sample_scene(rng))
    arrays = []
    for _ in range(100):
        simulated.step(rng.normal(size=3) * (0.01, 0.01, 0.03))
        arrays.append(np.concatenate([simulated.position, simulated.velocity, simulated.acceleration]))
    return np.stack(arrays), simulated.dropped, simulated.touched


@pytest.mark.parametrize("name", TASKS)
def test_compiled_equals_plain(name, monkeypatch):
    if substeps.choose_run() is substeps.run_plain:
        pytest.skip("the plain loop is all there is here")
    dropped = touched = 0
    for seed in range(6):
        compiled = trajectory(TASKS[name], monkeypatch, substeps.choose_run(), seed)
        plain = trajectory(TASKS[name], monkeypatch, substeps.run_plain, seed)
        assert compiled[0].tobytes() == plain[0].tobytes()
        assert compiled[1:] == plain[1:]
        dropped, touched = dropped + plain[1], touched + len(plain[2])
    assert dropped  # the comparison saw contacts break
    assert touched or name == "balance_reaching"  # and callbacks called


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("name", TASKS)
def test_many_worlds_at_once_move_as_each_alone(name, threads):
    task, count = TASKS[name], 12
    scenes = [task.sample_scene(np.random.default_rng(seed)) for seed in range(count)]
    alone, together = ([task.make_world(scene) for scene in scenes] for _ in range(2))
    rng = np.random.default_rng(0)
    for _ in range(60):
        actions = rng.normal(size=(count, 3)) * (0.01, 0.01, 0.03)
        world.step_worlds(together, actions, threads)
        for simulated, action in zip(alone, actions, strict=True):
            simulated.step(action)
    for a, b in zip(alone, together, strict=True):
        for attribute in ("position", "velocity", "acceleration", "commanded", "action"):
            assert getattr(a, attribute).tobytes() == getattr(b, attribute).tobytes()
        assert (a.steps, a.dropped, a.touched, a.errors) == (b.steps, b.dropped, b.touched, b.errors)
    assert any(w.dropped for w in together), "contacts were seen to break"


@pytest.mark.skipif(sys.platform == "win32", reason="no process forks there")
@pytest.mark.filterwarnings("ignore:.*use of fork")
def test_a_forked_process_has_threads_of_its_own():
    worlds = [TASKS["bin_dropping"].make_world(TASKS["bin_dropping"].ranges.scene()) for _ in range(8)]
    actions = np.zeros((8, 3))
    world.step_worlds(worlds, actions, threads=2)
    child = multiprocessing.get_context("fork").Process(target=world.step_worlds, args=(worlds, actions, 2))
    child.start()
    child.join(30)
    assert child.exitcode == 0


@pytest.mark.skipif(sys.platform != "linux", reason="known to compile on Linux")
def test_compiles():
    assert substeps.choose_run() is not substeps.run_plain


@pytest.mark.parametrize("error", [ImportError, OSError])
@pytest.mark.parametrize("missing", ["llvmlite", "pymunk._chipmunk"])
def test_plain_stands_in(missing, error, monkeypatch):
    found = builtins.__import__

    def refuse(name, *arguments, **more):
        if name == missing:
            raise error(name)
        return found(name, *arguments, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    assert substeps.choose_run.__wrapped__() is substeps.run_plain


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
