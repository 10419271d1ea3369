"""Linear probes of states whose relation to the dynamics is known."""

import math

import torch
from small import make_episodes

from dynmap_rl.evaluation import probing


def test_r2_of_linear_independent_and_constant_states(monkeypatch):
    episodes = make_episodes(40, 12)["train"]
    generator = torch.Generator().manual_seed(0)
    mix = torch.randn(6, 10, generator=generator)

    def features(_, episodes):
        position = episodes["dynamics", "position"]
        noise = torch.randn(*position.shape[:-1], 10, generator=generator)
        return {"latent": 5 * position @ mix + 3, "hidden1": noise, "hidden2": torch.zeros_like(noise)}

    monkeypatch.setattr(probing, "compute_features", features)
    r2 = probing.probe(None, episodes[:30], episodes[30:])
    assert min(r2["latent"]["position"]) > 0.999
    assert max(r2["hidden1"]["velocity"]) < 0.1
    assert max(r2["hidden2"]["velocity"]) < 1e-9, "a constant is no better than the mean"
    states = {len(part): features(None, part) for part in (episodes[:30], episodes[30:])}
    velocity = episodes["dynamics", "velocity"][30:, :, 2]
    for rounding in (1e-6, 0.0):  # at rest
        velocity[:] = 0.5 + rounding * torch.randn(velocity.shape, generator=generator)
        resting = probing.probe(None, episodes[:30], episodes[30:])
        assert math.isnan(resting["latent"]["velocity"][2])
        assert math.isfinite(probing.judge_states(resting)["r2"])

    known = torch.rand(episodes["dynamics", "position"].shape, generator=generator) > 0.2
    episodes["dynamics", "position"][~known] = 1e6
    monkeypatch.setattr(probing, "compute_features", lambda _, episodes: states[len(episodes)])
    assert min(probing.probe(None, episodes[:30], episodes[30:])["latent"]["position"]) < 0.9
    found = probing.probe(None, *(part for part in episodes.set("labelled", known).split([30, 10])))
    assert min(found["latent"]["position"]) > 0.999, "what is not known is no truth"


def test_nothing_is_explained_where_nothing_moves():
    found = probing.judge_states({"latent": {"velocity": [math.nan]}, "hidden1": {"velocity": [math.nan]}})
    assert found["verdict"] == "doubtful" and found["r2"] is None
    assert "nothing moves" in probing.judged_text(found)


def test_the_best_state_decides():
    def explain(*values):
        return {"velocity": list(values), "position": [1.0, 1.0]}

    good = {"latent": explain(0.1, 0.2), "hidden1": explain(0.72, 0.8), "hidden2": explain(1.0, 0.4)}
    found = probing.judge_states(good)
    assert (found["verdict"], found["state"], round(found["r2"], 3)) == ("good", "hidden1", 0.76)
    assert probing.judge_states(good | {"hidden1": explain(0.72, 0.75)})["verdict"] == "doubtful"
