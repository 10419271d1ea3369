"""The collect recipe: records, says that it is done, and answers mistakes with one line. It pushes in test_hub.py."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import run

from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.envs.tasks import TASKS
from recipes.collect import Config, main

RECIPE = Path(__file__).parents[2] / "recipes" / "collect.py"


@pytest.mark.parametrize(
    ("kind", "task", "name"),
    [("demonstrations", task, task) for task in TASKS]
    + [("exploration", "balance_reaching", "balance_reaching_exploration")],
)
def test_records_where_it_says_and_then_says_that_it_is_complete(
    tmp_path, monkeypatch, capsys, kind, task, name
):
    monkeypatch.chdir(tmp_path)
    config = Config(task=task, kind=kind, episodes=1, eval_episodes=1, workers=1)
    main(config)
    page = Path(f"runs/collect/{name}/report.html")
    assert capsys.readouterr().out == f"done: datasets/{name}\nwritten: {page}\n"
    assert "2 episodes (train 0:1, eval 1:2), 240 frames, 20 a second" in page.read_text()
    assert page.read_text().count("data:image/") == 2
    assert load_dataset(f"datasets/{name}").shape == (2, 120)
    assert [p.name for p in (tmp_path / "datasets").iterdir()] == [name]
    main(config)
    assert capsys.readouterr().out == f"complete already: datasets/{name}\nwritten: {page}\n"


def test_a_mistake_is_one_line(recording, tmp_path):
    result = run(tmp_path, "collect", "--output", str(recording))
    assert result.returncode == 2
    assert result.stderr.startswith(
        f"error: {recording} holds another recording (episodes: 4 there, 300 here"
    )
    assert result.stderr.count("\n") == 1


def test_help_imports_neither_torch_nor_lerobot(tmp_path):
    code = (
        "import runpy, sys\n"
        f"sys.argv = [{str(RECIPE)!r}, '--help']\n"
        "try: runpy.run_path(sys.argv[0], run_name='__main__')\n"
        "except SystemExit: pass\n"
        "print([m for m in ('torch', 'lerobot', 'datasets') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ)
    assert "--push_to_hub" in result.stdout
    assert result.stdout.endswith("[]\n")
