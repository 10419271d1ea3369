"""The README's snippets run, and its commands are understood by what they call."""

import argparse
import importlib
import re
import runpy
import shlex
import shutil
import sys
import tomllib
from pathlib import Path

import draccus
import pytest

from dynmap_rl.paper.cells import list_cells
from dynmap_rl.utils.cli import read_arguments
from dynmap_rl.runs.lookup import find_run

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def snippets(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


def commands():
    """The words of every command, with what ``python`` prints in a ``$(...)``."""
    text = ""
    for line in "".join(snippets("bash")).replace("\\\n", " ").splitlines():
        text += f"{line}\n"
        try:
            words = shlex.split(text, comments=True)
        except ValueError:  # a quotation that goes on in the next line
            continue
        text = ""
        if words:
            yield [re.sub(r"\$\(python -c 'print\((.*)\)'\)", lambda m: str(eval(m[1])), w) for w in words]


def scripts(folder):
    """The scripts of a folder that commands run, and their arguments."""
    for words in commands():
        for i, word in enumerate(words):
            if re.fullmatch(rf"{folder}/[\w/]+\.py", word):
                yield word, words[i + 1 :]


class Understood(Exception):
    """Said by a parser, before the script goes on."""


@pytest.fixture
def parse_only(monkeypatch):
    parse = argparse.ArgumentParser.parse_args

    def parse_and_stop(*arguments):
        raise Understood(parse(*arguments))

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)


@pytest.mark.filterwarnings("ignore:trajs_per_batch:FutureWarning")
@pytest.mark.filterwarnings("ignore:Nested TransformedEnvs:UserWarning")
@pytest.mark.filterwarnings("ignore:.*use of fork")
def test_python_snippets_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for snippet in snippets("python"):
        exec(compile(snippet, "README", "exec"), namespace)
    assert namespace["episodes"].shape == (4, 120)
    assert namespace["losses"]["loss_rgb"] > 0
    assert [batch.shape for batch in namespace["batches"]] == [(4, 20)] * 2
    assert namespace["metrics"]["eval/num_episodes"] == 4 and namespace["metrics"]["eval/success"] == 1
    assert namespace["frames"].shape == (2, 64, 64, 3)


def test_python_snippets_are_short():
    """But for a whole task."""
    for snippet in snippets("python"):
        lines = [line for line in snippet.splitlines() if line.strip()]
        assert len(lines) <= (45 if "class Lift(" in snippet else 10), snippet


def test_there_is_no_command_that_nothing_below_looks_at():
    for words in commands():
        name = next(word for word in words if not re.match(r"[A-Z_]+=", word))
        assert name in ("python", "uv", "pip", "hf") or name.startswith("lerobot-"), words


@pytest.mark.parametrize(("recipe", "arguments"), list(scripts("recipes")), ids=lambda part: str(part))
def test_the_options_of_recipes_are_understood(recipe, arguments):
    config_class = importlib.import_module(recipe.removesuffix(".py").replace("/", ".")).Config
    draccus.parse(config_class, args=read_arguments(arguments, config_class), exit_on_error=False)


@pytest.mark.parametrize(("script", "arguments"), list(scripts("tests")), ids=lambda part: str(part))
def test_the_options_of_scripts_are_understood(script, arguments, parse_only, monkeypatch):
    source = (ROOT / script).read_text()
    if "argparse" not in source:
        assert len(arguments) <= source.count("sys.argv[") and not any(a.startswith("-") for a in arguments)
        return
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    with pytest.raises(Understood):
        runpy.run_path(ROOT / script, run_name="__main__")


def parse_lerobot(name, arguments, monkeypatch):
    """The settings that LeRobot's script ``NAME`` reads from its arguments."""
    script = importlib.import_module(f"lerobot.scripts.lerobot_{name}")
    monkeypatch.setattr(sys, "argv", [f"lerobot-{name}", *arguments])
    if name == "dataset_viz":
        with pytest.raises(Understood) as understood:
            script.main()
        return understood.value.args[0]
    function = {"train": "train", "eval": "eval_main", "edit_dataset": "edit_dataset"}[name]
    keep = lambda config: config  # noqa: E731
    keep.__annotations__ = {"config": vars(script)[function].__wrapped__.__annotations__["cfg"]}
    return importlib.import_module("lerobot.configs.parser").wrap()(keep)()


def test_lerobots_commands_are_understood(tmp_path, parse_only, monkeypatch):
    """One after the other, in a folder where a training leaves its settings and ``python -c`` what it exports."""
    pytest.importorskip("accelerate")
    importlib.import_module("dynmap_rl.integrations.lerobot")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(
        find_run("balance_reaching"), "runs/decoupled/balance_reaching/position_velocity_recurrent"
    )
    seen = []
    for words in commands():
        if words[:2] == ["python", "-c"]:
            exec(words[2], {})
        elif words[0].startswith("lerobot-"):
            seen.append(words[0].removeprefix("lerobot-").replace("-", "_"))
            config = parse_lerobot(seen[-1], words[1:], monkeypatch)
            for name in ("last", "002500") if seen[-1] == "train" else ():
                config.policy.save_pretrained(config.output_dir / "checkpoints" / name / "pretrained_model")
                config.save_pretrained(config.output_dir / "checkpoints" / name / "pretrained_model")
    assert set(seen) == {"train", "eval", "dataset_viz", "edit_dataset"}
    assert Path("exported/model.safetensors").exists()


def test_extras_are_those_of_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = re.findall(r"\.\[(\w+)\]", README) + re.findall(r"--extra (\w+)", README)
    assert named and set(named) - {"x"} <= set(extras)


def test_hours_of_the_tables_are_those_of_their_cells():
    cells = {cell.name: cell for cell in list_cells()}

    def hours(table):
        own = [cell for cell in cells.values() if cell.table == table]
        needed = {cells[cell.needs] for cell in own if cell.needs} - set(own)
        return len(own), sum(cell.minutes for cell in own) / 60, sum(cell.minutes for cell in needed) / 60

    minutes = {cell.recipe: cell.minutes for cell in cells.values() if not cell.needs}
    with_one = {cell.minutes for cell in cells.values() if cell.needs}
    text, total = " ".join(README.split()), sum(cell.minutes for cell in cells.values()) / 60
    assert f"with its three policies takes some {minutes['decoupled']} minutes of one core" in text
    assert f"on a world model that is there {min(with_one)} to {max(with_one)}, three jointly" in text
    assert f"jointly trained seeds {minutes['joint']}, and the whole grid" in text
    assert f"(Table I has them), {total:.0f} hours:" in text
    count, own, needed = hours("I")
    assert needed == 0
    assert re.search(rf"--table I .*# {count} cells, {own:.1f} hours of one core\n", README)
    for table in ("II", "III"):
        count, own, needed = hours(table)
        said = rf"# {count} cells, {own:.1f} hours after Table I, {own + needed:.1f} without it\n"
        assert re.search(rf"--table {table} .*{said}", README)
