"""Conversion of run folders to LeRobot checkpoints and back."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors
from tensordict import TensorDict

from dynmap_rl.data.derive import add_dynamics
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.integrations.lerobot.actor import LeRobotActor
from dynmap_rl.integrations.lerobot.configuration_dynmap import DynmapConfig
from dynmap_rl.integrations.lerobot.environment import DynmapEnvConfig
from dynmap_rl.integrations.lerobot.export import export_to_lerobot, import_from_lerobot
from dynmap_rl.integrations.lerobot.modeling_dynmap import DynmapPolicy
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import (
    load_policy,
    load_world_model,
    make_world_model,
    save_policy,
    save_world_model,
)
from dynmap_rl.modules.checkpoints import make_policy as make_own_policy
from dynmap_rl.runs.lookup import load_actor, load_world_model_of, task_of_run
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.weights import fingerprint


def make_run(folder, kind, architecture="glimpse", goal=2, position=6, **frames):
    sizes = {"action": 3, "goal": goal, "position": position}
    meta = {name: {"low": [-1.0] * n, "high": [2.0] * n} for name, n in sizes.items()}
    world_model = make_world_model(meta, ("position",), 16, 24, architecture, **frames)
    policy = make_own_policy(meta, kind, world_model, width=20)
    save_world_model(folder / "world_model", world_model)
    save_policy(folder / "seed_1" / "policy", policy, world_model)
    return world_model, policy


@pytest.mark.parametrize("sizes", [{"goal": 3}, {"image_size": 32}, {"cameras": 2}])
def test_runs_of_other_sizes_are_refused(tmp_path, sizes):
    make_run(tmp_path / "run", "feedforward", **sizes)
    with pytest.raises(ValueError, match=f"got other sizes: {sizes}"):
        export_to_lerobot(tmp_path / "run", tmp_path / "exported", seed=1)


@pytest.mark.parametrize(
    ("kind", "architecture", "position"), [("recurrent", "glimpse", 6), ("feedforward", "plain", 3)]
)
def test_a_run_exports_to_lerobot_and_back(tmp_path, kind, architecture, position):
    run, exported, back = tmp_path / "run", tmp_path / "pretrained_model", tmp_path / "back"
    world_model, policy = make_run(run, kind, architecture, position=position)
    export_to_lerobot(run, exported, seed=1)
    theirs = make_policy(config_of(exported), env_cfg=DynmapEnvConfig())
    assert type(theirs) is DynmapPolicy
    preprocessor, postprocessor = make_pre_post_processors(theirs.config, pretrained_path=str(exported))
    import_from_lerobot(exported, back, seed=1)
    ours = load_world_model(back / "world_model"), load_policy(back / "seed_1" / "policy")
    for before, after in zip((world_model, policy), ours, strict=True):
        assert fingerprint(before) == fingerprint(after)

    frames = torch.randint(0, 256, (4, 2, 3, 64, 64), dtype=torch.uint8)
    states = torch.rand(4, 2, 5)
    again = DynmapPolicy.from_pretrained(export_to_lerobot(back, tmp_path / "again", seed=1))
    through_lerobot = LeRobotActor(exported)
    actor, memory = Actor(world_model, policy, mixed=True), TensorDict({}, [2])
    for pixels, agent_pos in zip(frames, states, strict=True):
        batch = {"observation.images.front": pixels / 255, "observation.state": agent_pos}
        action = postprocessor(theirs.select_action(preprocessor(batch)))
        assert torch.equal(action, again.select_action(batch))
        td = TensorDict({"pixels": pixels, "agent_pos": agent_pos, "goal": agent_pos[:, -2:]}, [2])
        assert torch.equal(action, through_lerobot(td)["action"])
        with torch.no_grad():
            td = actor(td.update(memory))
        assert torch.equal(action, td["action"])
        memory = td["next"]


def test_task_and_source_of_a_run_are_kept(tmp_path):
    run, source = tmp_path / "run", {"task": "balance_reaching", "training": "joint"}
    world_model, _ = make_run(run, "recurrent")
    write_json(run / "config.json", {"task": "bin_dropping", "seeds": "0,1,2"})
    write_json(run / "eval.json", {"world_model": source, "results": [{}]})
    exported = export_to_lerobot(run, tmp_path / "exported", seed=1)
    back = import_from_lerobot(exported, tmp_path / "back", seed=1)
    assert task_of_run(back) == task_of_run(exported) == "bin_dropping"
    model, found = load_world_model_of(back)
    assert (fingerprint(model), found) == (fingerprint(world_model), source)
    assert read_json(back / "eval.json") == {"world_model": source, "imported_from": str(exported)}
    with pytest.raises(ValueError, match="another"):
        import_from_lerobot(exported, run, seed=1)

    (run / "eval.json").unlink()  # not done yet
    unfinished = export_to_lerobot(run, tmp_path / "unfinished", seed=1)
    with pytest.raises(ValueError, match="again"):
        load_world_model_of(import_from_lerobot(unfinished, tmp_path / "again", seed=1))


def test_the_source_is_that_of_the_shared_world_model(tmp_path):
    exported = {}
    for name, training in (("a", "decoupled"), ("b", None), ("c", "joint")):
        make_run(tmp_path / name, "recurrent")
        if training:
            source = {"task": "balance_reaching", "training": training}
            write_json(tmp_path / name / "eval.json", {"world_model": source, "results": [{}]})
        exported[name] = export_to_lerobot(tmp_path / name, tmp_path / f"exported_{name}", seed=1)
    both = import_from_lerobot(exported["a"], tmp_path / "both")
    import_from_lerobot(exported["c"], both, seed=1)  # has a world model of its own
    assert load_world_model_of(both)[1]["training"] == "decoupled"
    import_from_lerobot(exported["b"], import_from_lerobot(exported["a"], tmp_path / "again"))
    with pytest.raises(ValueError, match="again"):
        load_world_model_of(tmp_path / "again")


def test_a_policy_of_lerobot_train_has_the_task_of_its_dataset(recording, tmp_path):
    dataset = LeRobotDataset("user/small", root=recording, video_backend="pyav")
    config = make_policy_config("dynmap", device="cpu", push_to_hub=False)
    make_policy(config, ds_meta=dataset.meta).save_pretrained(tmp_path / "pretrained_model")
    run = import_from_lerobot(tmp_path / "pretrained_model", tmp_path / "run")
    assert task_of_run(run) == "balance_reaching"
    assert load_world_model_of(run)[1] == {"task": "balance_reaching", "training": "joint"}


def test_a_policy_of_lerobot_train_has_the_sizes_of_its_dataset(recording, tmp_path):
    add_dynamics(recording, tmp_path / "command", columns=(0, 1, 2), replace=True)
    dataset = LeRobotDataset("user/small", root=tmp_path / "command", video_backend="pyav")
    policy = make_policy(make_policy_config("dynmap", device="cpu", push_to_hub=False), ds_meta=dataset.meta)
    policy.save_pretrained(tmp_path / "pretrained_model")
    again = DynmapPolicy.from_pretrained(tmp_path / "pretrained_model", strict=True)
    assert again.config.sizes == {"action": 3, "goal": 2, "position": 3, "velocity": 3, "acceleration": 3}
    assert fingerprint(again.world_model) == fingerprint(policy.world_model)


def config_of(folder):
    config = DynmapConfig.from_pretrained(folder)
    config.pretrained_path = folder
    return config


def test_policies_keep_the_world_models_that_they_were_trained_with(tmp_path):
    models = {}
    for seed in (0, 1):
        models[seed], _ = make_run(tmp_path / f"run_{seed}", "recurrent")
        exported = export_to_lerobot(tmp_path / f"run_{seed}", tmp_path / f"exported_{seed}", seed=1)
        import_from_lerobot(exported, tmp_path / "both", seed=seed)
    for seed, model in models.items():
        assert fingerprint(load_actor(tmp_path / "both", seed).world_model) == fingerprint(model)


def test_a_checkpoint_that_is_imported_again_replaces_the_world_model(tmp_path):
    both, exported = tmp_path / "both", []
    for number in range(3):
        make_run(tmp_path / f"run_{number}", "recurrent")
        exported.append(
            export_to_lerobot(tmp_path / f"run_{number}", tmp_path / f"exported_{number}", seed=1)
        )
    models = [fingerprint(load_world_model(tmp_path / f"run_{number}/world_model")) for number in range(3)]
    for number in (0, 1):
        import_from_lerobot(exported[number], both, seed=0)
        assert fingerprint(load_world_model(both / "world_model")) == models[number]
    import_from_lerobot(exported[2], both, seed=1)  # seed 0 needs the other one
    import_from_lerobot(exported[0], both, seed=1)
    assert [fingerprint(load_actor(both, seed).world_model) for seed in (0, 1)] == [models[1], models[0]]
    import_from_lerobot(exported[1], both, seed=1)
    assert not (both / "seed_1/world_model").exists()


def test_a_stopped_import_leaves_no_policy_beside_another_world_model(tmp_path, monkeypatch):
    both, exported = tmp_path / "both", []
    for number in range(2):
        make_run(tmp_path / f"run_{number}", "recurrent")
        exported.append(
            export_to_lerobot(tmp_path / f"run_{number}", tmp_path / f"exported_{number}", seed=1)
        )
    import_from_lerobot(exported[0], both, seed=0)
    with monkeypatch.context() as stopped:
        stopped.setattr("dynmap_rl.integrations.lerobot.export.save_policy", stop)
        with pytest.raises(KeyboardInterrupt):
            import_from_lerobot(exported[1], both, seed=0)
    with pytest.raises(ValueError, match="seed_0"):
        load_actor(both)
    import_from_lerobot(exported[1], both, seed=0)
    assert load_actor(both).policy is not None


def stop(*arguments):
    raise KeyboardInterrupt


def test_runs_on_robot_datasets_are_not_exported(tmp_path):
    make_run(tmp_path / "run", "recurrent")
    write_json(tmp_path / "run/config.json", {"dataset": "someone/robot", "task": None})
    with pytest.raises(ValueError, match="robot dataset"):
        export_to_lerobot(tmp_path / "run", tmp_path / "exported", seed=1)
    assert not (tmp_path / "exported").exists()


@pytest.mark.parametrize("changes", [{"kind": "feedforward"}, {"supervision": "position,velocity"}])
def test_weights_of_another_architecture_are_refused(tmp_path, changes):
    make_run(tmp_path / "run", "recurrent")
    exported = export_to_lerobot(tmp_path / "run", tmp_path / "exported", seed=1)
    config = config_of(exported)
    for name, value in changes.items():
        setattr(config, name, value)
    with pytest.raises(ValueError, match="weights of another architecture"):
        DynmapPolicy.from_pretrained(exported, config=config)


def test_damaged_checkpoints_are_named(tmp_path):
    make_run(tmp_path / "run", "recurrent")
    exported = export_to_lerobot(tmp_path / "run", tmp_path / "exported", seed=1)
    (exported / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="no weights that can be read"):
        import_from_lerobot(exported, tmp_path / "back")
    settings = read_json(exported / "config.json")
    write_json(exported / "config.json", settings | {"of_a_newer_version": 1})
    for load in (LeRobotActor, lambda folder: import_from_lerobot(folder, tmp_path / "back")):
        with pytest.raises(ValueError, match=str(exported)):
            load(exported)
    assert not (tmp_path / "back").exists()


def test_export_and_import_name_the_folder_that_does_not_fit(tmp_path):
    with pytest.raises(ValueError, match="arguments.json"):
        export_to_lerobot(tmp_path, tmp_path / "out")
    make_run(tmp_path / "other", "recurrent", goal=4)
    with pytest.raises(ValueError, match="goal"):
        export_to_lerobot(tmp_path / "other", tmp_path / "out", seed=1)
    with pytest.raises(ValueError, match=r"no config\.json"):
        import_from_lerobot(tmp_path, tmp_path / "run")
    make_policy_config("act", push_to_hub=False, device="cpu").save_pretrained(tmp_path)
    with pytest.raises(ValueError, match="act"):
        import_from_lerobot(tmp_path, tmp_path / "run")


def test_a_late_chunk_is_cut_at_the_present_step(tmp_path, monkeypatch):
    policy, calls = export_to_lerobot("balance_reaching", tmp_path), []
    with pytest.raises(ValueError, match="no chunks to cut"):
        LeRobotActor(policy, cut=True)
    monkeypatch.setattr(DynmapConfig, "n_action_steps", 2, raising=False)
    actor = LeRobotActor(policy, cut=True)
    assert "delay" in actor.in_keys and "delay" not in LeRobotActor(policy).in_keys

    def predict(batch):
        calls.append(batch)
        return 10.0 * len(calls) + torch.arange(5.0)[None, :, None].expand(2, -1, 3)

    actor.policy.predict_action_chunk = predict
    td = TensorDict(
        {"pixels": torch.zeros(2, 3, 64, 64, dtype=torch.uint8), "agent_pos": torch.zeros(2, 5)}, [2]
    )
    actions = [actor(td.set("delay", torch.tensor([[0], [delay]])))["action"][:, 0] for delay in (3, 9, 3, 3)]
    assert torch.stack(actions).tolist() == [[10, 13], [11, 14], [20, 23], [21, 24]]
    actor.reset()
    assert actor(td.set("delay", torch.tensor([[0], [7]])))["action"][:, 0].tolist() == [30, 34]
    assert len(calls) == 3


def test_chunks_of_several_observations_are_not_cut(tmp_path):
    policy = export_to_lerobot("balance_reaching", tmp_path)
    settings = read_json(policy / "config.json")
    write_json(policy / "config.json", settings | {"n_obs_steps": 2})
    with pytest.raises(ValueError, match="2 observations"):
        LeRobotActor(policy, cut=True)


def test_frames_are_those_of_the_policys_cameras(tmp_path):
    actor = LeRobotActor(export_to_lerobot("balance_reaching", tmp_path))
    features, seen = actor.policy.config.input_features, []
    features["observation.images.side"] = features.pop("observation.images.front")
    actor.policy.select_action = lambda batch: seen.append(batch) or torch.zeros(2, 3)
    frames = torch.randint(0, 256, (2, 3, 64, 128), dtype=torch.uint8)
    td = TensorDict({"pixels": frames[..., :64], "agent_pos": torch.zeros(2, 5)}, [2])
    assert actor(td)["action"].shape == (2, 3)
    assert torch.equal(seen[0]["observation.images.side"], td["pixels"] / 255)
    assert "observation.images.front" not in seen[0]
    with pytest.raises(ValueError, match="2 cameras"):
        actor(td.set("pixels", frames))


def make_task(*cameras, **changes):
    """Return what an actor reads of a task in space, with the sizes of the flat tasks."""
    layout = replace(get_task("balance_reaching").layout, cameras=cameras, **changes)
    return SimpleNamespace(name="slide", description="Slide.", planar=False, layout=layout)


def export_with_cameras(folder, *cameras):
    """Export the shipped run as a policy that reads these cameras."""
    path = export_to_lerobot("balance_reaching", folder)
    settings = read_json(path / "config.json")
    features = settings["input_features"]
    front = features.pop("observation.images.front")
    features |= {f"observation.images.{camera}": front for camera in cameras}
    write_json(path / "config.json", settings)
    return path


def test_cameras_of_a_task_are_found_by_their_names(tmp_path):
    frames = torch.randint(0, 256, (2, 3, 64, 128), dtype=torch.uint8)
    actor = LeRobotActor(export_to_lerobot("balance_reaching", tmp_path), task=make_task("side", "front"))
    seen, features = [], actor.policy.config.input_features
    actor.policy.select_action = lambda batch: seen.append(batch) or torch.zeros(2, 3)
    td = TensorDict({"pixels": frames, "agent_pos": torch.zeros(2, 5)}, [2])
    actor(td)
    features["observation.images.side"] = features["observation.images.front"]
    actor(td)
    side, front = (frames / 255).split(64, -1)
    for batch in seen:
        assert torch.equal(batch["observation.images.front"], front)
    assert "observation.images.side" not in seen[0]
    assert torch.equal(seen[1]["observation.images.side"], side)
    with pytest.raises(ValueError, match="1 cameras, but it reads .*side, .*front"):
        actor(td.set("pixels", frames[..., :64]))


def test_a_policy_of_another_task_is_refused(tmp_path):
    policy = export_with_cameras(tmp_path, "side")
    LeRobotActor(policy, task=get_task("balance_reaching"))  # the picture of a flat task may have any name
    with pytest.raises(ValueError, match=r"side of \[64, 64\] pixels instead of \[96, 96\]"):
        LeRobotActor(policy, task=make_task("side", image_size=96))
    with pytest.raises(ValueError, match="fit slide.* cameras side instead of front; choose the task"):
        LeRobotActor(policy, task=make_task("front"))
    task = make_task("front", "side", state=("goal_x",), action=("x",), action_limit=(1.0,))
    with pytest.raises(
        ValueError, match=r"has state \[5\] instead of \[1\], action \[3\] instead of \[1\]; choose"
    ):
        LeRobotActor(policy, task=task)
