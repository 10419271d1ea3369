"""The commit of the code that made a result."""

import subprocess

from dynmap_rl.utils import version

find_commit = version.find_commit.__wrapped__


def git(folder, *arguments):
    names = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    return subprocess.run(
        ["git", "-C", folder, *names, *arguments], check=True, capture_output=True, text=True
    ).stdout


def test_a_commit_and_whether_the_code_differs_from_it(tmp_path):
    assert find_commit(tmp_path) is None
    git(tmp_path, "init")
    assert find_commit(tmp_path) is None  # no commit yet
    (tmp_path / "a.py").write_text("1\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "first")
    commit = git(tmp_path, "rev-parse", "HEAD").strip()
    assert commit.startswith(find_commit(tmp_path)) and len(find_commit(tmp_path)) == 12
    (tmp_path / "result.json").write_text("{}")
    assert "dirty" not in find_commit(tmp_path)
    (tmp_path / "a.py").write_text("2\n")
    assert find_commit(tmp_path).endswith("-dirty")


def test_a_process_asks_once(monkeypatch):
    commit = version.find_commit()
    monkeypatch.setattr(subprocess, "run", None)
    assert version.find_commit() == commit


def test_a_folder_inside_of_another_checkout_has_no_commit(tmp_path):
    git(tmp_path, "init")
    (tmp_path / "a.py").write_text("1\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "first")
    (tmp_path / "site-packages").mkdir()
    assert find_commit(tmp_path / "site-packages") is None
