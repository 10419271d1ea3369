"""Pages: links lead somewhere, commands are understood, snippets run. Sentences are not tested."""

import argparse
import importlib
import re
import runpy
import shlex
import shutil
import sys
import tomllib
from pathlib import Path

import pytest
from own_task import check_renderer

from dynmap_rl.runs.lookup import SHIPPED
from dynmap_rl.utils.cli import parse_settings, read_arguments

ROOT = Path(__file__).parents[2]
PAGES = {
    str(path.relative_to(ROOT)): path.read_text()
    for path in (
        ROOT / "README.md",
        *(p for name in ("dynmap_rl", "recipes", "tests") for p in (ROOT / name).rglob("*.md")),
    )
}


def snippets(page, language):
    return re.findall(rf"```{language}\n(.*?)```", PAGES[page], re.S)


def commands():
    """Yield page and words of every command, with the output of ``python`` in the place of a ``$(...)``."""
    for page in PAGES:
        text = ""
        for line in "".join(snippets(page, "bash")).replace("\\\n", " ").splitlines():
            text += f"{line}\n"
            try:
                words = shlex.split(text, comments=True)
            except ValueError:  # a quotation that continues in the next line
                continue
            text = ""
            if words:
                yield (
                    page,
                    [re.sub(r"\$\(python -c 'print\((.*)\)'\)", lambda m: str(eval(m[1])), w) for w in words],
                )


def scripts(folder):
    """Return the scripts of a folder that commands run, with their arguments."""
    found = {}
    for _, words in commands():
        for i, word in enumerate(words):
            if re.fullmatch(rf"{folder}/[\w/]+\.py", word):
                found[" ".join(words[i:])] = word, words[i + 1 :]
    return [pytest.param(*one, id=name) for name, one in found.items()]


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files(page):
    targets = re.findall(r"\]\(([^)#\s]+)(?:#[\w-]+)?\)", PAGES[page])
    missing = [t for t in targets if "://" not in t and not (ROOT / page).parent.joinpath(t).exists()]
    assert missing == []
    anchors = re.findall(r"\]\(([^)\s]*\.md)?#([\w-]+)\)", PAGES[page])
    for file, anchor in anchors:
        text = ((ROOT / page).parent / file).read_text() if file else PAGES[page]
        assert anchor in [slug(title) for title in re.findall(r"^#+ (.*)$", text, re.M)]


def slug(title):
    """Return the anchor that GitHub gives a title."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def test_the_readme_is_short():
    assert len(PAGES["README.md"].splitlines()) <= 200


def test_every_command_is_looked_at():
    names = {next(w for w in words if not re.match(r"[A-Z_]+=", w)) for _, words in commands()}
    other = {"python", "torchrun", "uv", "pip", "hf", "git", "cd", "source"}
    assert not {name for name in names - other if not name.startswith("lerobot-")}


@pytest.mark.parametrize(("recipe", "arguments"), scripts("recipes"))
def test_the_options_of_recipes_are_understood(recipe, arguments):
    config_class = importlib.import_module(recipe.removesuffix(".py").replace("/", ".")).Config
    parse_settings(config_class, read_arguments(arguments, config_class))


class Understood(Exception):
    """Raised by a parser, before the script goes on."""


@pytest.fixture
def parse_only(monkeypatch):
    parse = argparse.ArgumentParser.parse_args

    def parse_and_stop(*arguments):
        raise Understood(parse(*arguments))

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)


@pytest.mark.parametrize(("script", "arguments"), scripts("tests"))
def test_the_options_of_scripts_are_understood(script, arguments, parse_only, monkeypatch):
    source = (ROOT / script).read_text()
    if "argparse" not in source:
        assert not arguments or "sys.argv[" in source
        return
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    with pytest.raises(Understood):
        runpy.run_path(ROOT / script, run_name="__main__")


@pytest.mark.parametrize("page", [page for page in PAGES if snippets(page, "python")])
def test_python_snippets_compile(page):
    for snippet in snippets(page, "python"):
        compile(snippet, page, "exec")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:trajs_per_batch:FutureWarning")
@pytest.mark.filterwarnings("ignore:Nested TransformedEnvs:UserWarning")
@pytest.mark.filterwarnings("ignore:.*use of fork")
@pytest.mark.parametrize("page", [page for page in PAGES if snippets(page, "python")])
def test_python_snippets_run(page, recording, tmp_path, monkeypatch):
    """In the order of the page, where a dataset has been recorded."""
    if "lerobot" in page:
        pytest.importorskip("accelerate")
    if "mujoco" in page:
        check_renderer()
        pytest.importorskip("metaworld")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "datasets").mkdir()
    (tmp_path / "datasets/balance_reaching").symlink_to(recording, target_is_directory=True)
    monkeypatch.syspath_prepend(tmp_path)
    namespace = {"__name__": "my_module"}
    for snippet in snippets(page, "python"):
        exec(compile(snippet, page, "exec"), namespace)


def parse_lerobot(name, arguments, monkeypatch):
    """Return the settings that LeRobot's script ``NAME`` reads from its arguments."""
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


@pytest.mark.slow
def test_commands_of_lerobot_are_understood(tmp_path, parse_only, monkeypatch):
    """One after the other, in a folder where a training leaves its settings and ``python -c`` its exports."""
    for package in ("accelerate", "metaworld"):
        pytest.importorskip(package)
    importlib.import_module("dynmap_rl.integrations.lerobot")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(
        SHIPPED / "balance_reaching", "runs/decoupled/balance_reaching/position_velocity_recurrent"
    )
    seen = set()
    for page, words in commands():
        if words[:2] == ["python", "-c"] and "lerobot" in page:
            exec(words[2], {})
        elif words[0].startswith("lerobot-"):
            name = words[0].removeprefix("lerobot-").replace("-", "_")
            seen.add(name)
            config = parse_lerobot(name, words[1:], monkeypatch)
            for checkpoint in ("last", "002500") if name == "train" else ():
                folder = config.output_dir / "checkpoints" / checkpoint / "pretrained_model"
                config.policy.save_pretrained(folder)
                config.save_pretrained(folder)
    assert seen >= {"train", "eval"}


def test_extras_are_those_of_the_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    text = "".join(PAGES.values())
    named = re.findall(r"\.\[(\w+)\]", text) + re.findall(r"--extra (\w+)", text)
    assert set(named) <= set(extras)
