"""Keys, mouse and picture of the play window, without a display."""

import numpy as np
import pytest
from small import CONSTANTS, make_model

from dynmap_rl.envs.renderer import pygame
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy, make_world_model
from dynmap_rl.play.session import Session
from dynmap_rl.play.window import PlayWindow, _name_body


def press(window, *names):
    for name in names:
        for kind in (pygame.KEYDOWN, pygame.KEYUP):
            pygame.event.post(pygame.event.Event(kind, key=pygame.key.key_code(name)))
    window.handle()


@pytest.fixture
def window():
    window = PlayWindow(Session("balance_reaching"), size=128)
    yield window
    window.close()


def test_keys_and_mouse(window):
    played = window.session
    press(window, "tab")
    assert played.driver == "expert"
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_LEFT))
    window.handle()
    assert played.driver == "person" and played.person.direction.tolist() == [-1, 0, 0]
    pygame.event.post(pygame.event.Event(pygame.KEYUP, key=pygame.K_LEFT))
    window.handle()
    assert played.person.direction.tolist() == [0, 0, 0]
    middle = {"pos": (8 + 64, 8 + 20 + 64), "button": 1}
    pygame.event.post(pygame.event.Event(pygame.MOUSEBUTTONDOWN, middle | {"button": 4}))  # the wheel
    window.handle()
    assert played.person.target is None
    pygame.event.post(pygame.event.Event(pygame.MOUSEBUTTONDOWN, middle))
    window.handle()
    assert played.person.target == (0.5, 0.5)
    pygame.event.post(pygame.event.Event(pygame.MOUSEBUTTONUP, middle))
    press(window, "space", "b")
    assert played.person.target is None and window.paused and window.body == "cart"
    first = played.scene_seed
    press(window, "r", "i", "f5")
    assert played.scene_seed != first and not played.imagining
    now = played.scene_seed
    press(window, "page up", "page down")
    assert played.scene_seed == now and played.delay == 0, "without a policy there are no late frames"
    press(window, "escape")
    assert not window.open


def test_bodies_may_have_names_of_several_words():
    entries = "left_hand_x", "left_hand_omega_x", "left_foot_y", "x", "cart_theta"
    assert [*map(_name_body, entries)] == ["left_hand", "left_hand", "left_foot", "x", "cart"]


def test_the_window_shows_the_scene_and_traces(window):
    before = window.draw()
    window.session.driver = "expert"
    for _ in range(20):
        window.session.step()
    after = window.draw()
    assert after.shape == (window.height, window.width, 3)
    assert (before != after).any(-1).sum() > 100


def test_with_a_world_model_its_prediction_is_shown():
    world_model = make_model()
    session = Session(
        "balance_reaching", Actor(world_model, make_policy(CONSTANTS, "recurrent", world_model))
    )
    window = PlayWindow(session, size=64)
    right = 2 * 8 + 64
    session.step()
    before = window.draw()[28 : 28 + 64, right : right + 64]
    assert (before == session.prediction["pixels"]).all()
    left = slice(28, 28 + 64), slice(8, 8 + 64)
    scene = window.renderer.draw(session.world, session.env.task)
    assert (window.draw()[left] == scene).all()
    press(window, "i")
    assert session.imagining
    assert (window.draw()[left] != scene).any(), "cart and block as the model believes"
    session.step()
    assert (window.draw()[28 : 28 + 64, right : right + 64] == session.prediction["pixels"]).all()
    press(window, "page up", "page up", "page up", "page down")
    assert session.delay == 2 and session.world.steps == 0
    session.step()
    scene = window.renderer.draw(session.world, session.env.task)
    assert (window.draw()[left] != scene).any()
    window.close()


def test_predictions_of_other_dynamics_are_not_compared():
    other = CONSTANTS | {"position": {"low": [0.0] * 3, "high": [1.0] * 3}}  # such as the commanded pose
    world_model = make_world_model(other, ("position",), latent_size=16, hidden_size=24).eval()
    actor = Actor(world_model, make_policy(other, "recurrent", world_model, width=16).eval())
    session = Session("balance_reaching", actor, delay=2)
    window = PlayWindow(session, size=128)
    for _ in range(4):
        session.step()
        window.draw()
    window.close()
    assert list(session.prediction) == ["pixels"]
    assert np.isnan(np.stack(session.trace["position", "predicted"])).all()
