"""Files: complete at any moment, checked when read, locked by one process."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from dynmap_rl.utils.files import check_form, lock_folder, read_json, write_json


def test_json_round_trip_leaves_no_other_file(tmp_path):
    value = {"a": [1, 2.5, None], "b": {"c": "d"}, "e": [[1, 2], {"f": []}]}
    write_json(tmp_path / "new/file.json", {})
    write_json(tmp_path / "new/file.json", value)
    assert read_json(tmp_path / "new/file.json") == value
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["file.json"]


def test_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "file.json"
    write_json(path, 1)
    with pytest.raises(TypeError):
        write_json(path, object())
    monkeypatch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_json(path, 2)
    assert read_json(path, int) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file.json"]


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"\xff" * len(b)])
def test_a_damaged_file_is_named(tmp_path, damage):
    path = tmp_path / "config.json"
    write_json(path, {"a": 1})
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=r"config\.json"):
        read_json(path)


def test_deep_nesting_is_an_error_of_the_file(tmp_path):
    (tmp_path / "deep.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match=r"deep\.json"):
        read_json(tmp_path / "deep.json", list)


@pytest.mark.parametrize(
    ("value", "form", "place"),
    [
        ([], dict, "file must"),
        ({}, {"a": int}, "file, a"),
        ({"a": {"b": [1, "2"]}}, {"a": {"b": [int]}}, "file, a, b, 1"),
        ({"x": 1, "y": None}, {str: int}, "file, y"),
    ],
)
def test_a_value_of_another_form_is_named_by_its_place(value, form, place):
    with pytest.raises(ValueError, match=place):
        check_form(value, form, "file")


def test_a_folder_is_locked_by_one_process_until_it_ends(tmp_path):
    code = (
        "import sys; from pathlib import Path; from dynmap_rl.utils.files import lock_folder\n"
        "lock_folder(Path(sys.argv[1])); print('locked', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "run")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "locked\n"
        with pytest.raises(ValueError, match="in use by another process"):
            lock_folder(tmp_path / "run")
        other.kill()
    lock_folder(tmp_path / "run")
    lock_folder(tmp_path / "run")


def test_what_json_lacks_is_null(tmp_path):
    write_json(tmp_path / "a.json", {"one": math.nan, "more": [1.0, -math.inf], "deep": [[math.nan], 2]})
    text = (tmp_path / "a.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == {
        "one": None,
        "more": [1.0, None],
        "deep": [[None], 2],
    }
