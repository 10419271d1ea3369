"""LeRobot's policies: the command that trains them, and how a stopped run goes on."""

import pytest

from recipes import baseline


@pytest.fixture
def train(monkeypatch, recording, tmp_path):
    """Return a function that trains with options of the recipe and returns the arguments of ``lerobot-train``."""

    def train(code=0, **options):
        calls = []

        def run_script(script, arguments, folder, log, threads):
            calls.append(arguments)
            log.write_text("steps\nno memory\n")
            return code

        monkeypatch.setattr("dynmap_rl.utils.processes.run_script", run_script)
        baseline.train(baseline.Config(**options), recording, tmp_path, 3, "cpu")
        return calls[0]

    return train


@pytest.mark.parametrize("policy", ["act", "diffusion"])
def test_the_full_size_has_no_size_of_ours(train, policy):
    small, full = (set(train(policy=policy, full_size=size)) for size in (False, True))
    assert small - full == set(baseline.OPTIONS[policy]) and not full - small
    assert {f"--policy.type={policy}", "--seed=3"} <= full


def test_it_trains_on_the_training_split_alone(train, recording):
    from dynmap_rl.data import load_meta

    [given] = [option for option in train() if option.startswith("--dataset.episodes=")]
    assert given.partition("=")[2] == str(list(range(*load_meta(recording)["splits"]["train"])))


def test_a_stopped_run_goes_on_at_its_last_checkpoint(train, recording, tmp_path):
    """The stored settings name the places of before the run or the dataset was moved."""
    settings = tmp_path / "lerobot" / baseline.TRAINED / "train_config.json"
    settings.parent.mkdir(parents=True)
    settings.touch()
    places = [f"--output_dir={tmp_path / 'lerobot'}", f"--dataset.root={recording}"]
    assert train() == [f"--config_path={settings}", "--resume=true", "--policy.device=cpu", *places]


def test_a_failed_training_ends_with_the_last_line_of_its_log(train):
    with pytest.raises(ValueError, match="ends with: no memory"):
        train(code=1)


def test_episodes_that_no_page_would_show_are_refused():
    settings = baseline.Evaluation(paper_episodes=50)
    with pytest.raises(ValueError, match="--eval.paper_episodes"):
        baseline.main(baseline.Config(eval=settings))
