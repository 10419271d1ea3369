"""What the README says: its numbers are those of the results in the repository."""

import importlib
import json
import re
from pathlib import Path

import pytest

from dynmap_rl.evaluation.statistics import wilson
from dynmap_rl.paper.findings import markdown_findings
from dynmap_rl.paper.findings import markdown_spread
from dynmap_rl.paper.findings import spread
from dynmap_rl.paper.published import TABLES
from dynmap_rl.paper.tables import COLUMNS
from dynmap_rl.paper.tables import markdown_overview
from dynmap_rl.paper.tables import markdown_table
from dynmap_rl.paper.tables import read_cells

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_tables_are_those_of_the_results():
    results = ROOT / "recipes/results"
    assert markdown_overview(results) in README
    for columns in COLUMNS.values():
        for column in columns:
            assert markdown_table(results, column) in README, column


def test_the_findings_are_those_of_the_results():
    assert markdown_findings(ROOT / "recipes/results") in README


def test_claims_are_those_of_the_results():
    """The numbers that the prose rounds."""
    cells = read_cells(ROOT / "recipes/results")
    text = " ".join(README.split())

    def rates(policy, *rows, name="SR", training="decoupled"):
        found = (cells["balance_reaching", training, policy, row] for row in rows)
        return [cell["test_protocol"][name] for cell in found]

    with_position = "RGB+[P]", "RGB+[P+V]", "RGB+[P+A]", "RGB+[P+V+A]"
    without = "Only-RGB", "RGB+[V]", "RGB+[A]", "RGB+[V+A]"
    both = [rate for policy in ("feedforward", "recurrent") for rate in rates(policy, *with_position)]
    assert round(rates("recurrent", "Only-RGB")[0]) == round(rates("feedforward", "Only-RGB")[0]) == 62
    assert min(both) > 99
    assert "position takes the decoupled policies from 62 % to above 99 %" in text
    drops = [rates(policy, *without, name="DR") for policy in ("feedforward", "recurrent")]
    drop = f"drops the block in {min(drops[0]):.0f} to {max(drops[0]):.0f} % of the episodes"
    assert f"{drop} and a recurrent one in under 1 %" in text and max(drops[1]) < 1
    joint = {
        row: rates("recurrent", row, training="joint")[0] for row in ("End-to-End", *with_position, *without)
    }
    assert min(joint[row] for row in with_position) > 99
    gaps = [joint[row] - rates("recurrent", row)[0] for row in without]
    first = joint["End-to-End"] - rates("recurrent", "Only-RGB")[0]
    better = f"training is {min(gaps):.0f} to {max(gaps):.0f} points better, and so is end-to-end training ({first:.0f})"
    assert better in text
    seeds = [
        seed["test"]["summary"]["SR"]
        for seed in cells["balance_reaching", "joint", "recurrent", "RGB+[V+A]"]["results"]
    ]
    assert (
        f"one of the three seeds reached {min(seeds):.0f} % and the others above {min(sorted(seeds)[1:]) - 0.5:.0f}"
        in text
    )
    second = {
        training: {
            row: cells["balance_reaching_obstacle", training, "recurrent", row]["test_protocol"]["SR"]
            for row in (*with_position, *without)
        }
        for training in ("decoupled", "joint")
    }
    gaps = {row: second["decoupled"][row] - second["joint"][row] for row in second["joint"]}
    with_p, without_p = [gaps[row] for row in with_position], [-gaps[row] for row in without]
    assert (
        f"decoupled ones are {min(with_p):.0f} to {max(with_p):.0f} points better where position was" in text
    )
    assert f"joint ones {min(without_p):.0f} to {max(without_p):.0f} where it was not" in text
    plain = second["decoupled"]["Only-RGB"]
    worth = [second["decoupled"][row] - plain for row in with_position]
    costs = [plain - second["decoupled"][row] for row in without[1:]]
    assert f"each with position at least {min(worth):.0f};" in text
    third = {
        (training, row): cells["bin_dropping", training, "recurrent", row]["test_protocol"]["SR"]
        for training in ("decoupled", "joint")
        for row in (*with_position, *without)
    }
    gaps = [third["decoupled", row] - third["joint", row] for row in with_position]
    assert f"on task 3 decoupled ones are {min(gaps):.0f} to {max(gaps):.0f} better with position" in text
    alone, together = (
        third["decoupled", row] - third["decoupled", "Only-RGB"] for row in ("RGB+[P]", "RGB+[P+V+A]")
    )
    assert f"and position alone {alone:.0f}, but all three together lose {-together:.0f}." in text
    worse = [third["decoupled", "Only-RGB"] - third["decoupled", row] for row in without[1:]]
    two, three = (
        f"{min(lost):.0f} to {max(lost):.0f} on task {task}" for lost, task in ((costs, 2), (worse, 3))
    )
    assert f"velocity and acceleration cost {two} and {three}" in text
    own = [third["joint", row] - third["joint", "Only-RGB"] for row in with_position]
    assert f"worth {own[0]:.0f} alone and {min(own[1:3]):.0f} to {max(own[1:3]):.0f} with one other" in text
    rest = [-own[3], *(third["joint", "Only-RGB"] - third["joint", row] for row in without[1:])]
    assert f"the rest cost {min(rest):.0f} to {max(rest):.0f}." in text
    own = [second["joint"][row] - second["joint"]["Only-RGB"] for row in with_position]
    assert f"position is worth {min(own):.0f} to {max(own):.0f} points on task 2" in text
    main = cells["balance_reaching", "decoupled", "recurrent", "RGB+[P+V]"]["test_protocol"]
    assert f"an SR of {main['SR']:.1f} % and a PE of {main['PE']:.0f} mm" in text
    for name, task in (("balance_reaching_obstacle", 2), ("bin_dropping", 3)):
        with_dynamics, plain = (
            cells[name, "decoupled", "recurrent", row]["test_protocol"]["SR"]
            for row in ("RGB+[P+V]", "Only-RGB")
        )
        assert re.search(rf"is worth {with_dynamics - plain:.0f} (points )?on task {task}", text)
        file = f"recipes/results/{name}_own_position_velocity_recurrent.json"
        rate = json.loads((ROOT / file).read_text())["test_protocol"]["SR"]
        assert f"[{rate:.1f} %]({file}) in task {task}" in text


def test_claims_about_end_to_end_training_and_the_papers_numbers():
    cells = read_cells(ROOT / "recipes/results")
    text = " ".join(README.split())
    rates = {key: cell["test_protocol"]["SR"] for key, cell in cells.items()}
    tasks = "balance_reaching", "balance_reaching_obstacle", "bin_dropping"
    decoupled, joint = (
        [
            rates[task, training, "recurrent", "Only-RGB"] - rates[task, "joint", "recurrent", "End-to-End"]
            for task in tasks
        ]
        for training in ("decoupled", "joint")
    )
    one, two, three = (f"{gap:.0f}" for gap in joint)
    assert f"Only-RGB is {one}, {two} and {three} points better than End-to-End on tasks 1 to 3" in text
    assert f"decoupled {decoupled[1]:.0f} and {decoupled[2]:.0f} on tasks 2 and 3" in text
    below = {key: TABLES[key[:3]][key[3]][-1][0] - rate for key, rate in rates.items()}
    below = {key: gap for key, gap in below.items() if gap >= 0.5}
    assert not any("P" in row or task == "bin_dropping" for task, *_, row in below)
    for start, column in (
        ("by {} to {} points in the decoupled recurrent", ("balance_reaching", "decoupled", "recurrent")),
        ("by {} to {} in feed-forward", ("balance_reaching", "decoupled", "feedforward")),
        ("by {} to {} on task 2", ("balance_reaching_obstacle", "decoupled", "recurrent")),
    ):
        gaps = [below.pop(key) for key in list(below) if key[:3] == column]
        assert start.format(round(min(gaps)), round(max(gaps))) in text
    [(key, gap)] = below.items()
    assert key == ("balance_reaching_obstacle", "joint", "recurrent", "RGB+[V+A]")
    assert f"by {gap:.0f} in its joint [V+A]" in text


def test_the_spread_over_world_models_is_that_of_the_results():
    results = ROOT / "recipes/results"
    assert markdown_spread(results) in README
    rows = {row["row"]: row for row in spread(results)}
    plain, velocity = (
        f"{rows[row]['mean']:.1f} (std {rows[row]['std']:.1f})" for row in ("Only-RGB", "RGB+[V]")
    )
    said = f"over three world models each, velocity alone reaches {velocity} and Only-RGB {plain}, and"
    assert said in " ".join(README.split())


def test_every_file_that_the_readme_names_exists():
    for path in re.findall(r"(?:recipes|dynmap_rl|tests)/[\w/]+\.(?:py|json|png|gif)", README):
        assert (ROOT / path).exists(), path


def test_rates_of_the_experts_are_those_of_the_results():
    def rates(name):
        return json.loads((ROOT / f"recipes/results/expert_{name}.json").read_text())["rates"]

    across = rates("balance_reaching_obstacle_balance_reaching")
    text = " ".join(README.split())
    assert f"blocks the straight path in {across['straight_path_blocked']:.1f} %" in text
    assert f"the way leads around it in {across['way_leads_around']:.1f} %" in text
    assert f"task 1's expert fails in {100 - across['success']:.1f} %" in text
    own = rates("balance_reaching_obstacle_balance_reaching_obstacle"), rates("bin_dropping_bin_dropping")
    assert f"task 2's succeeds in {own[0]['success']:.1f} % and task 3's in {own[1]['success']:.1f} %" in text


def test_ranges_of_the_dynamics_are_those_of_the_results():
    ranges = json.loads((ROOT / "recipes/results/distributions.json").read_text())["ranges"]
    one, three = ranges["balance_reaching"], ranges["bin_dropping"]
    text = " ".join(README.split())
    assert (
        f"within {one['block angle'][2]:.2f} rad in task 1 and {three['block angle'][2]:.1f} rad in task 3"
        in text
    )
    speeds = f"{one['block angular velocity'][2]:.1f} and {three['block angular velocity'][2]:.0f} rad/s"
    assert speeds in text


def test_the_speed_table_is_that_of_the_results(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tests/benchmarks")
    benchmarks = importlib.import_module("run")
    results, main_jobs = (json.loads(path.read_text()) for path in (benchmarks.RESULTS, benchmarks.MAIN_JOBS))
    assert benchmarks.markdown(results, main_jobs) in README
    minutes = [run["real_seconds"] / 60 for run in main_jobs["runs"]]
    assert f"[{min(minutes):.0f} to {max(minutes):.0f} minutes from a fresh clone]" in README
    judged = main_jobs["runs"][0] | {"SR": 99.87, "SR_interval": [99.61, 100.0], "PE": 12.34}
    assert " min, SR 99.9 % [99.6, 100.0], PE 12.3 mm |" in benchmarks.markdown(results, {"runs": [judged]})


def test_errors_of_derived_dynamics_are_those_of_the_results():
    facts = json.loads((ROOT / "recipes/results/derivatives.json").read_text())
    text, derived, tracked = " ".join(README.split()), facts["derived"], facts["tracked"]

    def mm(kind):
        return f"{1000 * derived[kind]['velocity']['linear']:.0f}"

    means = {name: values["linear"] for name, values in facts["mean_magnitude"].items()}
    acceleration = derived["central"]["acceleration"]["linear"]
    for sentence in (
        f"velocities are off by {mm('central')} mm/s (their mean is {1000 * means['velocity']:.0f})",
        f"accelerations by {acceleration:.2f} m/s^2 ({means['acceleration']:.2f})",
        f"velocities are off by {mm('central, noisy')} mm/s, with `--method savgol` by {mm('savgol, noisy')}",
        f"picture's x is {1000 * tracked['x_error_m']:.0f} mm ({64 * tracked['x_error_m']:.1f} pixels) off",
        f"correlates with the cart's by {tracked['velocity_correlation']:.2f}",
    ):
        assert sentence in text


def test_memory_is_that_of_the_results(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tests/benchmarks")
    commands = importlib.import_module("memory").COMMANDS
    peak = json.loads((ROOT / "recipes/results/memory.json").read_text())["peak"]
    text = " ".join(README.split())
    assert peak["decoupled"] < 4 and peak.keys() <= commands.keys()
    for name in commands:
        if name in peak:  # recipes of one number share it: `a` and `b` 4.0
            assert re.search(rf"`{name}`(?:(?:,| and) `\w+`)* {peak[name]:.1f}(?!\d)", text), name


def test_the_soak_is_that_of_the_results():
    facts = json.loads((ROOT / "recipes/results/soak.json").read_text())
    text, held = " ".join(README.split()), facts["held_mb"]
    assert facts["steps"] == 1_000_000
    said = (
        f"{facts['episodes']:,} episodes, hold {held[-1]} MB at the end and {held[0]} after the first tenth"
    )
    assert f"A million control steps with frames, {said}" in text


def test_ppo_on_latents_is_that_of_the_results():
    facts = json.loads((ROOT / "recipes/results/latent_ppo_balance_reaching.json").read_text())
    latents, states = facts["latents"], facts["states"]
    text = " ".join(README.split())
    assert (
        f"in {100 * latents['success']:.1f} % of 1,000 fresh scenes, {1000 * latents['position_error']:.1f} mm off on "
        f"average, after {latents['frames']:,} frames ({latents['seconds'] / 60:.0f} minutes of one core)"
        in text
    )
    assert (
        f"PPO on states in {100 * states['success']:.1f} %, {1000 * states['position_error']:.1f} mm off"
        in text
    )


def test_errors_on_the_foreign_dataset_are_those_of_the_results():
    facts = json.loads((ROOT / "recipes/results/gliding.json").read_text())
    ours, constant = facts["held_out"]["position"], facts["spread"]["position"]
    text = " ".join(README.split())
    assert (
        f"to {ours['x']:.3f} and {ours['y']:.3f} (of a frame's width and height; the best constant: "
        f"{constant['x']:.3f} and {constant['y']:.3f})" in text
    )
    assert f"({ours['angle']:.1f} rad; the constant {constant['angle']:.2f};" in text
    assert facts["command"] in README

    facts = json.loads((ROOT / "recipes/results/so100_demo.json").read_text())
    ours, constant = facts["held_out"]["position"], facts["spread"]["position"]
    shown = "shoulder_pan", "shoulder_lift", "gripper"
    (a, b, c), (d, e, f) = ([values[joint] for joint in shown] for values in (ours, constant))
    assert (
        f"are off by {a:.2f}, {b:.2f} and {c:.2f} (the best constant: {d:.2f}, {e:.2f} and {f:.2f})" in text
    )
    assert all(ours[joint] > constant[joint] for joint in ours.keys() - shown)
    assert facts["command"] in README


def test_what_a_world_model_knows_is_that_of_the_results():
    facts = json.loads((ROOT / "recipes/results/probe.json").read_text())
    without, with_dynamics = (
        facts["probes"][f"{row}, decoupled"]["hidden2"] for row in ("Only-RGB", "RGB+[P+V]")
    )
    text = " ".join(README.split())

    def r2(values):
        return f"{sum(values) / len(values):.2f}"

    assert (
        f"`hidden2` with an R^2 of {r2(with_dynamics['position'])} (Only-RGB: {r2(without['position'])}), "
        f"velocities with {r2(with_dynamics['velocity'])} ({r2(without['velocity'])})"
    ) in text
    errors = facts["open_loop"]["RGB+[P+V], decoupled"]
    model, still = errors["model"], errors["still"]
    assert (
        f"the cart is {model['cart_mm'][-1]:.0f} mm off and the block {model['block_mm'][-1]:.0f} mm, where standing "
        f"still would be {still['cart_mm'][-1]:.0f} mm off" in text
    )


def test_the_shipped_policy_is_that_of_the_results():
    facts = json.loads((ROOT / "recipes/results/pretrained_balance_reaching.json").read_text())
    assert facts["command"].startswith("python recipes/evaluate.py --policy balance_reaching ")
    low, high = facts["summary"]["SR_interval"]
    rate, error = facts["summary"]["SR"], facts["summary"]["PE"]
    assert f"[SR {rate:.1f} % [{low:.1f}, {high:.1f}], PE {error:.1f} mm]" in README


@pytest.mark.parametrize("policy", ["act", "diffusion", "dynmap"])
def test_what_lerobot_trained_is_that_of_the_results(policy):
    ours, theirs = (
        json.loads((ROOT / f"recipes/results/{policy}_{name}.json").read_text())
        for name in ("balance_reaching", "lerobot_eval")
    )
    low, high = ours["summary"]["SR_interval"]
    said = f"[SR {ours['summary']['SR']:.1f} % [{low:.1f}, {high:.1f}], PE {ours['summary']['PE']:.1f} mm]"
    assert f"{said}(recipes/results/{policy}_balance_reaching.json)" in README
    count, rate = theirs["n_episodes"], theirs["pc_success"]
    least, most = wilson(round(count * rate / 100), count)
    said = f"[{rate:.1f} % [{least:.1f}, {most:.1f}] of {count}]"
    assert f"{said}(recipes/results/{policy}_lerobot_eval.json)" in README
    assert least <= high and low <= most, "by our protocol and by LeRobot's"


def test_kills_are_those_of_the_results():
    found = json.loads((ROOT / "recipes/results/kills.json").read_text())
    assert list(found) == ["collect", "expert", "decoupled", "tables"]
    assert {recipe["kills"] for recipe in found.values()} == {20}
    assert "Killed at 20 random moments each, `collect`, `expert`, `decoupled` and `tables`" in " ".join(
        README.split()
    )


def test_the_validators_are_those_of_the_results():
    found = json.loads((ROOT / "recipes/results/validators.json").read_text()).values()
    text = " ".join(README.split())
    assert all(task[name]["exit"] == 0 for task in found for name in ("robovet", "lerobot-doctor"))
    assert all(task["rdq"]["exit"] == 1 and "--fail-under 100" in task["rdq"]["command"] for task in found)
    assert all("0 fail · 0 warn · 1 info · 29 pass" in task["robovet"]["said"] for task in found)
    assert all("Summary: 8 PASS | 3 WARN" in task["lerobot-doctor"]["said"] for task in found)
    scores = [re.search(r"Score (\d+)/100", " ".join(task["rdq"]["said"]))[1] for task in found]
    assert "robovet passes 29 of 29 checks; lerobot-doctor finds no failure" in text
    assert f"rdq gives {scores[0]}, {scores[1]} and {scores[2]} of 100" in text
