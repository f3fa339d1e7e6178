import argparse
import ast
import collections
import dataclasses
import itertools
import json
import random
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import envs
from envs._quiet import State
from envs.arena import Arena
from star.abstraction import reachability
from star.abstraction.forward_model import Outcome
from star.abstraction.reachability import MISSES, REACHES
from star.agent.decisions import Decision
from star.config import loading
from star.learners import crl, replay
from star.learners.sections import CRLConfig
from star.spec import Spec
from star.training import program as programs
from star.training.checkpoint import Checkpoints, Damaged
from star.training.journal import JsonLines
from tests.scripts import load

SCRIPTS = Path(__file__).parents[1] / "scripts"
FILES = sorted(path.relative_to(SCRIPTS).with_suffix("").as_posix() for path in SCRIPTS.rglob("*.py"))


@pytest.mark.parametrize("name", FILES)
def test_a_script_takes_from_modules_only_what_they_have(name):
    script = load(name)
    modules = {alias: value for alias, value in vars(script).items() if isinstance(value, ModuleType)}
    found = [node for node in ast.walk(ast.parse(Path(script.__file__).read_text())) if isinstance(node, ast.Attribute)]
    used = [
        (node.value.id, node.attr) for node in found if isinstance(node.value, ast.Name) and node.value.id in modules
    ]
    assert [f"{module}.{attr}" for module, attr in used if not hasattr(modules[module], attr)] == []


@pytest.mark.parametrize("held", [None, "", "/there:/elsewhere"])
def test_what_a_script_starts_finds_packages_where_the_script_found_them(tmp_path, monkeypatch, held):
    monkeypatch.setenv("PYTHONPATH", held or "")
    if held is None:
        monkeypatch.delenv("PYTHONPATH")
    wanted = f"{tmp_path}:{held}" if held else str(tmp_path)  # an empty entry would be the current folder
    assert load("processes").importing(tmp_path) == {"PYTHONPATH": wanted}


def test_scripts_set_the_path_of_packages_in_one_way():
    others = {name for name in FILES if '"PYTHONPATH":' in (SCRIPTS / f"{name}.py").read_text()}
    assert others == {"processes", "checks/wheel"}  # a wheel is tried with nothing else


def test_the_periods_of_an_agent_are_told_with_the_regions_that_hold_its_places(run, capsys):
    script = load("checks/periods")
    script.main([str(run), "--seed", "6", "--episodes", "3", "--commands", "2"])
    head, goal, *lines = capsys.readouterr().out.splitlines()
    assert head == "seed 6, 160 env steps, 4 regions; the agent does not arrive"
    numbers = lambda text: [float(x) for x in re.findall(r"-?\d+\.\d", text)]  # noqa: E731
    x, y, *corners = numbers(goal)
    assert corners[0] <= x <= corners[2] and corners[1] <= y <= corners[3]
    steps, (told, *commands) = lines[:2], lines[2:]
    assert [int(line.split()[0]) for line in steps] == [0, 20]
    assert max(map(abs, numbers(steps[0])[:2])) < 0.3  # the start
    assert all(line.count("(") == 3 for line in steps)  # the place, and a subgoal every ten env steps
    low_x, low_y, high_x, high_y = numbers(told)
    assert low_x <= 0.0 <= high_x and low_y <= 0.0 <= high_y and "2 periods began here" in told
    assert len(commands) == 2 and all("number" in line for line in commands)
    with pytest.raises(SystemExit, match="2"):
        script.main([str(run), "--seed", "9"])
    assert capsys.readouterr().err == f"error: --seed: 9 is not among those of {run}: 5, 6\n"


def test_the_check_of_the_physics_passes_and_notices_another_model(monkeypatch):
    script = load("checks/physics")
    options = argparse.Namespace(
        engine="native",
        preset="fast",
        reference=None,
        envs=20,
        rollouts=20,
        steps=20,
        throws=20,
        random_steps=100,
    )
    row = script.verify("ant_fall", options)
    assert row["passed"] and (row["crossings"], row["non_finite"], row["overflow"]) == (0, 0, 0)
    assert row["one_step"] < 1e-5 and row["contacts"] >= 2
    batch = script.Batch("ant_fall", "native", 20, preset="fast", reference="fast")
    batch.model.opt.gravity[2] *= 0.9
    assert script.one_step(batch)["one_step"] > 1e-3
    monkeypatch.setattr(Arena, "walls", Arena.free)
    assert script.throws(batch, 20) == {"crossings": 20, "over": 0}  # everywhere is now a wall


def test_the_check_against_jaxgcrl_gives_each_motor_its_own_action_and_counts_contacts():
    script, env = load("checks/against_jaxgcrl"), envs.make("ant_open", preset="jaxgcrl", engine="native")
    model, rng = env.body.physics.model, np.random.default_rng(0)
    assert [model.actuator(i).name for i in script.MOTORS[:3]] == ["hip_4", "ankle_4", "hip_1"]  # its first motors
    action, data = rng.uniform(-1, 1, (2, 8)).astype(np.float32), mujoco.MjData(model)
    before = np.zeros((2, 29), np.float32)
    before[:, :15] = data.qpos
    before[:, 2] = [0.5, 1.2]
    seen = script.Seen(before, np.zeros((2, 14), np.float32), action, before, np.zeros(2, bool))
    after, done = script.stepped(env, seen)
    assert done.tolist() == [False, True]
    for i in range(2):
        mujoco.mj_resetData(model, data)
        data.qpos = before[i, :15]
        data.ctrl[script.MOTORS] = 150 * action[i]
        mujoco.mj_step(model, data, nstep=5)
        np.testing.assert_allclose(after[i], [*data.qpos, *data.qvel], atol=1e-5)
    before[1, 0] = 28.0
    assert script.touching(model, before) == {"walls": 1, "itself": 0}


def test_lives_are_counted_until_the_first_end_and_by_its_reason(monkeypatch):
    script = load("checks/crl_against_jaxgcrl")
    monkeypatch.setattr(script, "ENVS", 3)
    monkeypatch.setattr(script, "STEPS", 10)

    def at(height, place):
        second_hip = -place
        pose = jnp.zeros(15).at[jnp.array([1, 2, 9])].set(jnp.asarray([place, height, second_hip]))
        obs, over = jnp.concatenate([pose, jnp.full(14, 2.0)]), (height < 0.2) | (height > 1)
        return State(None, obs, jnp.zeros(()), jnp.float32(over), {})

    climber = argparse.Namespace(
        dt=0.05,
        reset=lambda key: at(0.5, 0.0),
        step=lambda state, action: at(state.obs[2] + action, state.obs[1] + action),
    )
    found = script.lives(climber, lambda obs, key: jnp.asarray([0.2, -0.2, 0.0]))  # 1.1 m in step 3, .1 m in step 2
    speed = (3 * 0.2 + 2 * 0.2) / (3 + 2 + 10) / 0.05
    counts = {"env_steps": 3 + 2 + 10, "ends": 2, "high": 1}
    assert found == counts | {"speed": round(speed, 3), "hinges": 2.0, "hip": 0.6}


def test_the_last_layer_of_our_actor_is_two_of_jaxgcrls():
    rng, sizes = np.random.default_rng(0), (3, 4, 4, 6)
    layer = lambda n, m: {"kernel": rng.normal(size=(n, m)), "bias": rng.normal(size=m)}  # noqa: E731
    actor = {"params": {f"Dense_{i}": layer(*sizes[i : i + 2]) for i in range(3)}}
    x = rng.normal(size=(5, 3))
    mean, std = crl._policy(CRLConfig(hidden=(4, 4)), jax.tree.map(jnp.float32, actor), jnp.float32(x))
    *hidden, means, raw = load("checks/crl_against_jaxgcrl").as_theirs(actor)["params"].values()
    for one in hidden:
        x = x @ one["kernel"] + one["bias"]
        x = x / (1 + np.exp(-x))
    np.testing.assert_allclose(x @ means["kernel"] + means["bias"], mean, rtol=1e-4)
    log_std = -5 + 3.5 * (np.tanh(x @ raw["kernel"] + raw["bias"]) + 1)
    np.testing.assert_allclose(np.exp(log_std), std, rtol=1e-4)


def test_the_benchmark_measures_both_loops():
    script = load("benchmarks/physics")
    options = argparse.Namespace(preset="fast", steps=3, repeats=2)
    row = script.measure("ant_maze", "native", 4, options)
    assert row["bare"] > 0 and row["full"] > 0 and len(row["ratios"]) == 2


def test_the_benchmark_of_an_epoch_calls_its_parts_as_they_are(run, monkeypatch):
    script = load("benchmarks/epoch")
    build, timed = programs.build, []

    def seconds(function, *arguments):
        timed.append(jax.eval_shape(function, *arguments))  # traced, not compiled
        return 0.5

    monkeypatch.setattr(script, "_seconds", seconds)
    still = lambda agent, lessons, state: (state, {})  # noqa: E731

    def without_epoch(config):
        program = build(config)
        return dataclasses.replace(program, functions=dataclasses.replace(program.functions, epoch=still))

    monkeypatch.setattr(programs, "build", without_epoch)
    row = script.benchmark(run / "config.yaml", 1, {})
    assert row["physics_env_steps_per_s"] == 200 * 4 * 2 / 0.5 and len(timed) == 4
    assert row["refinement_share"] == row["forward_model_share"] == 0.5 / row["epoch_s"]
    assert row["planning_share"] == 2 * 0.5 / row["epoch_s"]  # of two periods an episode


def report(name, finals, *, to_level):
    seeds = [
        {
            "seed": i,
            "episodes": 200,
            "success_any": 1.0,
            "success_final": final,
            "env_steps_to_level": steps,
            "training_seconds_to_level": steps and steps / 1e6,
            "seconds_to_level": steps and steps / 1e5,
        }
        for i, (final, steps) in enumerate(zip(finals, to_level, strict=True))
    ]
    return {"name": name, "seeds": seeds, "env_steps_per_seed": 2_500_000}


def test_the_table_tells_means_over_seeds_with_intervals_and_who_never_got_there():
    script = load("results/reproduce")
    text = script.table(
        [
            report("star", [0.0, 1.0, 1.0, 1.0, 1.0], to_level=[3e6, 1e6, 2e6, 9e6, None]),
            report("flat", [0.0] * 5, to_level=[1e6, None, None, None, 1e6]),
        ]
    )
    star, flat = (line.split(" | ") for line in text.splitlines()[2:])
    assert star[1:4] == ["5", "2.5 M", "1.000 [0.996, 1.000]"]
    assert star[4].startswith("0.800 [") and star[5:8] == ["5 of 5 [0.48, 1.00]", "1 1 1 1 1", "3.0 M"]
    assert star[8:] == ["3 s", "30 s |"]
    assert flat[4] == "0.000 [0.000, 0.004]" and flat[7] == "never"
    low, high = (float(x) for x in star[4][7:-1].split(","))
    assert low < 0.8 < high <= 1


def test_agents_and_ablations_are_found_and_others_refused():
    script = load("results/reproduce")
    assert script.layer("star") == []
    assert script.layer("hiro") == ["--with", "configs/agents/hiro.yaml"]
    assert script.layer("grid") == ["--with", "configs/ablations/grid.yaml"]
    hiro, tutor = "configs/agents/hiro.yaml", "configs/ablations/td3_tutor.yaml"
    assert script.layer("hiro+td3_tutor") == ["--with", hiro, "--with", tutor]
    with pytest.raises(SystemExit, match="hirro: no such agent; known are star, "):
        script.layer("hirro")


TODAY = {"settings": "a1", "moved": {"tutor": 0.5}}


def test_seeds_that_are_there_already_are_not_trained_again(tmp_path, monkeypatch):
    """A stand-in for `star` writes metrics and reports the seeds that its run was trained with."""
    script, trained = load("results/reproduce"), []

    def run(command, **kwargs):
        _, _, _, verb, *rest = command
        if verb == "train":
            folder, count = Path(rest[rest.index("--run-dir") + 1]), int(rest[rest.index("--seeds") + 1])
            seeds = [int(rest[rest.index("--seed") + 1]) + i for i in range(count)]
            trained.append(seeds)
            row = {"env_steps": 500, "wall_s": 9.0, "env_steps_per_s": 100.0 * count, "eval/success_any": 0.9}
            folder.mkdir(parents=True)
            (folder / "config.yaml").touch()
            rows = "".join(json.dumps(row | {"seed": seed}) + "\n" for seed in seeds)
            (folder / "metrics.jsonl").write_text(rows, encoding="utf-8")
            start = {"env_steps": 0, "commit": "abc", "device": "abacus", "python": "3", "versions": {}}
            (folder / "provenance.jsonl").write_text(json.dumps(start) + "\n", encoding="utf-8")
            return None
        seeds = [json.loads(line)["seed"] for line in (Path(rest[0]) / "metrics.jsonl").read_text().splitlines()]
        success = {"test": 1.0, "train": 0.8}[rest[rest.index("--goals") + 1]]
        one = {"episodes": 200, "success_any": success}
        report = {"seeds": [one | {"seed": seed, "success_final": seed / 4} for seed in seeds]}
        return argparse.Namespace(stdout=json.dumps(report) + "\n")

    monkeypatch.setattr(script.subprocess, "run", run)
    monkeypatch.setattr(script.digest, "of", lambda command: TODAY)
    common = ["--runs", str(tmp_path / "runs"), "--commit", "c0ffee"]
    for seeds, flags, out in ((2, (), "a"), (5, (), "a"), (2, ("--one-by-one",), "b"), (2, ("--one-by-one",), "b")):
        folder = tmp_path / out
        script.main(["point_maze", "star", "--seeds", str(seeds), "--out", str(folder), *common, *flags])
    assert trained == [[0, 1], [2, 3, 4], [0], [1]]
    kept = json.loads((tmp_path / "a" / "star.json").read_text(encoding="utf-8"))
    assert [seed["seed"] for seed in kept["seeds"]] == [0, 1, 2, 3, 4]
    assert [(program["seeds"], program["commit"]) for program in kept["runs"]] == [
        ([0, 1], "c0ffee"),
        ([2, 3, 4], "c0ffee"),
    ]
    assert {program["device"] for program in kept["runs"]} == {"abacus"}
    assert {seed["training_seconds_to_level"] for seed in kept["seeds"]} == {5.0}
    assert {program["digest"]["settings"] for program in kept["runs"]} == {"a1"}
    script.main(["point_maze", "star", "--seeds", "1", "--out", str(tmp_path / "c"), *common, "--", "--seed", "7"])
    assert trained[-1] == [0] and len(list((tmp_path / "runs" / "point_maze").glob("star-0-*"))) == 3
    script.main(["point_maze", "star", "--goals", "test", "train", "--out", str(tmp_path / "d"), *common])
    both = json.loads((tmp_path / "d" / "star.json").read_text(encoding="utf-8"))["seeds"]
    assert [seed["success_any"] for seed in both] == [1.0] * 5
    assert [(seed["train"]["seed"], seed["train"]["success_any"]) for seed in both] == [(i, 0.8) for i in range(5)]
    assert "| star | 5 | 0.5 k | 1.000 [0.996, 1.000] | 0.500 [" in (tmp_path / "a" / "table.md").read_text()
    (tmp_path / "a" / "star.json").unlink()
    (tmp_path / "a" / "notes.json").write_text("not a report", encoding="utf-8")
    script.main(["point_maze", "star", "--out", str(tmp_path / "a"), "--runs", str(tmp_path / "others")])
    assert len((tmp_path / "a" / "curves.jsonl").read_text().splitlines()) == 5

    monkeypatch.setattr(script.digest, "of", lambda command: TODAY | {"moved": {"tutor": 0.6}})
    before = len(trained)
    script.main(["point_maze", "star", "--seeds", "2", "--out", str(tmp_path / "a"), *common])
    kept = json.loads((tmp_path / "a" / "star.json").read_text(encoding="utf-8"))
    assert trained[before:] == [[0, 1]] and [seed["seed"] for seed in kept["seeds"]] == [0, 1]  # begun anew
    assert len((tmp_path / "a" / "curves.jsonl").read_text().splitlines()) == 2


def test_a_row_is_measured_anew_as_its_json_says(tmp_path, monkeypatch):
    script, asked = load("results/reproduce"), []
    monkeypatch.setattr(script, "fill", asked.append)
    script.main(["ant_fall/gara", "ant_fall/one_by_one/star"])
    out = script.ROOT / "results" / "ant_fall"
    many = ["--trainer.num_envs", "2048", "--total-env-steps", "20000000", "--commander.epsilon_steps", "5000000"]
    told = ["--seed", "0", "--seeds", "5", "--out", str(out), "--level", "0.9", "--episodes", "200", "--", *many]
    assert asked[0] == ["ant_fall", "gara", *told]
    assert asked[1][-2:] == ["--one-by-one", "--"] and asked[1][7] == str(out / "one_by_one")
    script.main(["ant_fall/gara", "--runs", "elsewhere"])
    assert asked[2] == [*asked[0][: -len(many) - 1], "--runs", "elsewhere", "--", *many]
    with pytest.raises(SystemExit, match=r"ant_fall/garra: results/ant_fall/garra.json is no row of results"):
        script.main(["ant_fall/gara", "ant_fall/garra"])
    assert len(asked) == 3  # nothing is measured before all rows are found


TUNE = load("tune")


class Lost(Exception):
    """The machine is gone."""


@pytest.fixture
def tuned(tmp_path, monkeypatch):
    """Tune HIRO on the Point Maze with a stand-in for training: (programs that were asked for, how to tune)."""
    worth, asked = {"plain": 0.2, "progress": 0.4, "less_noise": 0.4, "unroll_5": 0.1}, []
    settings = {name: TUNE.words(one) for name, one in yaml.safe_load(TUNE.CONFIGURATIONS.read_text())["hiro"].items()}

    def measure(task, name, seeds, options, given, *, goals):
        *own, key, steps = given
        assert (task, name, goals, key) == ("point_maze", "hiro", ("train",), "--trainer.total_env_steps")
        (chosen,) = [one for one, words in settings.items() if words == own]
        asked.append((chosen, tuple(seeds), int(steps)))
        if len(asked) == fails_at:
            raise error
        score = worth[chosen] if len(seeds) == 2 else 1 - worth[chosen]  # with more env steps it is the other way round
        rows = [{"seed": seed, "success_behind_walls": score, "success_any": 0.9} for seed in seeds]
        return {"rows": [{"env_steps": int(steps), "wall_s": 2.0}], "evaluated": rows, "run": {"command": "star train"}}

    fails_at, error = None, Lost()
    tune = TUNE.tune
    monkeypatch.setattr(TUNE, "tune", lambda tuning, path, options: tune(tuning, path, options, measure))

    def run(*words, at=None, by=None):
        nonlocal fails_at, error
        fails_at, error = at, by or Lost()
        TUNE.main(["point_maze", "hiro", "--out", str(tmp_path / "tuning.json"), "--env-steps", "100", "200", *words])
        return json.loads((tmp_path / "tuning.json").read_text())

    return asked, run


def test_tuning_halves_twice_with_seeds_of_its_own_and_goes_on_after_a_lost_machine(tuned, tmp_path, capsys):
    asked, run = tuned
    with pytest.raises(Lost):
        run(at=3)
    assert len(json.loads((tmp_path / "tuning.json").read_text())["programs"]) == 2
    asked.clear()
    found = run()
    first, second = (10, 11), (12, 13, 14)
    assert asked == [
        ("less_noise", first, 100), ("unroll_5", first, 100), ("progress", second, 200), ("less_noise", second, 200)
    ]  # fmt: skip
    assert [one["score"] for one in found["programs"]] == pytest.approx([0.2, 0.4, 0.4, 0.1, 0.6, 0.6])
    assert found["chosen"] == "progress" and found["signal"] == "success_behind_walls"
    assert "chosen: progress" in capsys.readouterr().out
    before = (tmp_path / "tuning.json").stat()
    assert run(at=len(asked) + 1) == found and (tmp_path / "tuning.json").stat() == before  # nothing is trained again


def test_a_configuration_that_breaks_is_worth_nothing_and_others_go_on(tuned):
    asked, run = tuned
    found = run(at=2, by=subprocess.CalledProcessError(TUNE.NOT_FINITE, ["star", "train"]))
    assert [one["score"] for one in found["programs"]] == pytest.approx([0.2, 0.0, 0.4, 0.1, 0.6, 0.8])
    assert found["programs"][1]["broke"] == "not finite" and found["chosen"] == "plain" and len(asked) == 6
    TUNE.table(found)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("point_maze hirro", "hirro: has no configurations in tune.yaml; known are frugal, "),
        ("point_mase hiro", "configs/point_mase.yaml: no such file"),
        ("point_maze hiro --out other.json", "other.json: is no tuning; choose another --out"),
        ("point_maze hiro --out old.json", "old.json: is another tuning, with agent hrac, not hiro; choose another"),
        ("point_maze hiro -- --tutor.perod 5", "command line: tutor.perod: unknown key (did you mean tutor.period?)"),
        ("point_maze hiro -- --tutor.period", "--tutor.period: needs a value"),
    ],
)
def test_a_tuning_that_cannot_be_is_refused_in_one_line(tmp_path, capsys, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    Path("other.json").write_text("[]")
    Path("old.json").write_text(json.dumps({"task": "point_maze", "agent": "hrac"}))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(SystemExit) as ended:
        TUNE.main(words.split())
    line = capsys.readouterr().err
    assert ended.value.code == 2 and line.startswith(f"error: {said}") and line.count("\n") == 1
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("agent", yaml.safe_load(TUNE.CONFIGURATIONS.read_text()))
@pytest.mark.parametrize("task", ["ant_maze", "ant_fall"])
def test_all_agents_are_tuned_with_four_configurations_that_differ(agent, task):
    options = argparse.Namespace(task=task, agent=agent, signal=None, episodes=9, env_steps=[4_000_000, 8_000_000])
    plan = TUNE.plan(options, {})
    layers = load("results/reproduce").layer(agent)[1::2]
    configs = [loading.load(f"configs/{task}.yaml", one, layers=layers) for one in plan["configurations"].values()]
    assert len(configs) == 4 and all(config.trainer.num_envs == 512 for config in configs)
    assert all(one != other for one, other in itertools.combinations(configs, 2))
    assert plan["signal"] == ("success_any" if task == "ant_fall" else "success_behind_walls")


def test_seeds_that_follow_one_another_share_a_program():
    groups = load("results/reproduce").groups
    assert groups([0, 1, 4, 5, 7], one_by_one=False) == [[0, 1], [4, 5], [7]]
    assert groups([0, 1, 4], one_by_one=True) == [[0], [1], [4]]
    assert groups([], one_by_one=False) == []


def test_curves_are_drawn(tmp_path):
    points = [
        {"name": name, "seed": seed, "env_steps": step, "wall_s": step / 100, "eval/success_any": 0.5}
        for name in ("star", "flat")
        for seed in (0, 1)
        for step in (100, 200)
    ]
    script = load("results/reproduce")
    script.draw(points, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000
    for number, point in enumerate(points):
        if point["name"] == "star":
            point |= {"sgim/queries_guide": 3.0, "sgim/share_guide": number / 10, "sgim/share_autonomous": 0.5}
    assert script._asked(points, "flat") == {}
    assert script._asked(points, "star") == pytest.approx({100: (0 + 0.2) / 2, 200: (0.1 + 0.3) / 2})
    script.draw(points, tmp_path / "asked.png")
    assert (tmp_path / "asked.png").stat().st_size > (tmp_path / "curves.png").stat().st_size


@pytest.fixture
def four_regions(tiny):
    return {**tiny["abstraction"], "cuts": [[8.0], [8.0]]}


def test_verdicts_are_compared_with_what_rollouts_did(tiny, breaking_env, fresh, four_regions):
    script = load("checks/abstraction")
    spec = Spec.of(breaking_env.env)
    agent, state = loading.parse({**tiny, "abstraction": four_regions}).hyper(), fresh(abstraction=four_regions)
    verdict = state.graph.verdict.at[0, 1].set(REACHES).at[1, 0].set(MISSES)
    state = state.replace(graph=state.graph.replace(verdict=verdict))
    # (region, target, next region): 0 -> 1 is right in 3 of 4 rollouts, 1 -> 0 in 1 of 2. One does not count, one is
    # at the goal, one stays.
    seen = np.array([(0, 1, 1), (0, 1, 1), (0, 1, 1), (0, 1, 0), (1, 0, 1), (1, 0, 0), (2, 3, 2), (0, 1, 0), (2, 2, 2)])
    region, target, next_region = seen.T
    weight = np.array([1, 1, 1, 1, 1, 1, 1, 0, 1], np.float32)
    point = np.zeros((9, 2), np.float32)
    unused = dict.fromkeys(("reward", "lost", "goal"))
    where = {"region": region, "target": target, "next_region": next_region, "goal_region": np.full(9, 3)}
    decision = Decision(**where, weight=weight, aside=np.zeros(9, np.float32), **unused)
    outcome = Outcome(start=point, lower=point, upper=point, end=point + 3, weight=weight)
    walls = np.array([[2.0, -99.0, 7.5, 99.0]])
    finished = dict.fromkeys(("reaches", "misses", "all"), (decision, outcome))
    row = script.judge(agent, spec, state, finished, walls)
    assert row["reaches"] == {"share": 0.75, "rollouts": 4, "pairs": 1}
    assert row["misses"] == {"share": 0.5, "rollouts": 2, "pairs": 1}
    assert row["base"]["rollouts"] == 6 and row["error"]["still"] == pytest.approx(18**0.5)
    assert row["walls"]["share"] == 0.5  # of 4 faces, 2 at x = 8 beside the wall's side at 7.5 and 2 at y = 8


def test_the_fair_table_takes_one_setting_of_each_selector_for_all_beds():
    script = load("benchmarks/selection")
    rest = {"t90": [1, 1], "hopeless": 0.0, "idle": 0.0}
    found = [
        {"bed": bed, "selector": name, "constants": constants, "auc": [auc, auc + 0.02]} | rest
        for bed, name, constants, auc in [
            ("a", "first", "1", 0.9), ("a", "first", "2", 0.7), ("a", "second", "", 0.6),
            ("b", "first", "1", 0.1), ("b", "first", "2", 0.5), ("b", "second", "", 0.8),
        ]
    ]  # fmt: skip
    assert [(rows[0]["selector"], rows[0]["constants"]) for rows in script.fair(found)] == [
        ("second", ""),
        ("first", "2"),
    ]
    lines = script.table(found).splitlines()
    assert "| first | 2 | 0.610 [0.483, 0.737] | 0.710 | 0.510 |" in lines
    assert any(line.startswith("| first | 1 | 0.910") for line in lines)  # the best of bed a alone


@settings(max_examples=5)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_random_triple_of_the_check_of_soundness_lies_outside_of_its_hull(seed):
    script = load("checks/soundness")
    script.NETWORKS, script.MODELS = script.NETWORKS[:1], script.MODELS[:1]
    row = script.check_triples(10_000, seed=seed, chunk=5000)
    assert row["triples"] >= 10_000 and row["outside"] == 0 and row["nearest_ulp"] > 0


def test_the_check_of_soundness_judges_all_pairs_and_notices_a_hull_that_is_too_small(
    tiny, fresh, four_regions, monkeypatch
):
    """The forward model moves everything one region to the right, and by some noise."""
    script, state = load("checks/soundness"), fresh(abstraction=four_regions)
    agent = loading.parse({**tiny, "abstraction": four_regions}, {"refinement.parts": 8, "refinement.depth": 3}).hyper()
    layer = state.forward_model.params["params"]["Dense_1"]
    moving = {"kernel": 0.1 * layer["kernel"], "bias": jax.numpy.array([1.0, 0.0])}
    params = {"params": {**state.forward_model.params["params"], "Dense_1": moving}}
    starts = jax.random.uniform(jax.random.key(1), (64, 2), minval=-4.0, maxval=20.0)
    ring = replay.add(state.forward_model.ring, Outcome(starts, starts, starts, starts, weight=jax.numpy.ones(64)))
    state = state.replace(forward_model=state.forward_model.replace(params=params, ring=ring))
    row = script.check_verdicts(agent, state, points=50)
    assert row["pairs"] == 12
    for name, lost in (("strict", "do_not_arrive"), ("trained", "outside_hull")):
        assert row[name]["parts"] >= 2 and row[name]["points"] == row[name]["parts"] * 54
        assert row[name][lost] == row[name]["outside_hull"] == 0
    pushed = reachability.pushed

    def middle(*box):
        (low, high), smear = pushed(*box)
        return (0.6 * low + 0.4 * high, 0.4 * low + 0.6 * high), smear

    monkeypatch.setattr(reachability, "pushed", middle)
    row = script.check_verdicts(agent, state, points=50)
    assert row["strict"]["do_not_arrive"] > 0 and row["trained"]["outside_hull"] > 0


def test_the_benchmark_of_devices_measures_physics_and_compares_with_one_device(run):
    script = load("benchmarks/devices")
    seconds = script.physics(programs.build(loading.load(run / "config.yaml")), 2)
    assert len(seconds) == 2 and min(seconds) > 0
    one = {"devices": 1, "physics": 100.0, "acting": 50.0, "epoch": 20.0}
    two = {"devices": 2, "physics": 200.0, "acting": 90.0, "epoch": 34.0}
    assert script.ratio(two, one) == {"physics": 2.0, "acting": 1.8, "epoch": 1.7}
    assert script.ratio(two, two) is None


def test_the_soak_test_damages_a_checkpoint_so_that_it_is_noticed_and_finds_what_differs(run, tmp_path):
    script, chance = load("checks/soak"), random.Random(0)
    for kind in script.KINDS:
        copy = tmp_path / kind
        shutil.copytree(run, copy)
        assert script.damage(copy / "checkpoints" / "160", kind, chance)
        with pytest.raises(Damaged):
            Checkpoints(copy).check(160)
    row = {"env_steps": 160, "loss": 0.5}
    shutil.copytree(run, tmp_path / "run")
    for wall_s in (1.0, 2.0):
        JsonLines(tmp_path / "run" / "metrics.jsonl").write(row | {"wall_s": wall_s})
    one = script.end(tmp_path / "run")
    assert one["metrics"] == [row, row] and script.differs(one, script.end(tmp_path / "run")) == []
    other = {**one, "arrays": {**one["arrays"], "epoch": b""}, "metrics": [row]}
    assert script.differs(one, other) == ["epoch", "metrics"]


def test_growth_of_memory_is_that_from_the_first_minute_after_settling_to_the_last():
    growth = load("checks/soak").growth
    samples = [{"s": s, "host_mib": 100.0 + min(s, 300) + (s > 600) * 3, "device_mib": 7.0} for s in range(0, 901, 5)]
    found = growth(samples, settle_s=300)
    assert found["host_mib"] == {"before": 400.0, "after": 403.0, "growth": 3.0}
    assert found["device_mib"]["growth"] == 0
    assert growth(samples, settle_s=1000) == {} == growth([], settle_s=0)


@pytest.fixture
def fuzz(monkeypatch):
    """The script, which builds what is accepted and trains nothing."""
    script = load("checks/fuzz")
    monkeypatch.setattr(programs, "build", script.Shared(0))
    monkeypatch.setattr(jax.config, "update", lambda *_: None)  # `trainer.device: cpu` is for a process
    return script


def test_odd_configs_are_accepted_or_refused_in_one_line_and_leave_nothing_behind(fuzz):
    ended = []
    fuzz.fuzz(200, 1, limit=60, tell=lambda case, trial: ended.append((trial.ended, case, trial.line)))
    counts = collections.Counter(one[0] for one in ended)
    assert set(counts) <= {"refused", "built", "helped"}, [one for one in ended if one[0] not in ("refused", "built")]
    assert counts["refused"] > 50 and counts["built"] > 10


@pytest.mark.parametrize(
    ("does", "ended"),
    [
        (lambda: print("error: a\nb", file=sys.stderr) or 2, "not one line"),
        (lambda: print("error: a", file=sys.stderr) or Path("left").write_text("") or 2, "file left behind"),
        (lambda: 1 / 0, "traceback"),
        (lambda: 0, "no run, or more"),
        (lambda: time.sleep(5), "hang"),
        (lambda: print("error: a", file=sys.stderr) or 2, "refused"),
        (lambda: print("oh", file=sys.stderr) or 3, "not one line"),
        (lambda: print("stopped: not finite after", file=sys.stderr) or 3, "no run, or more"),
    ],
)
def test_the_fuzzer_notices_what_is_wrong(fuzz, monkeypatch, does, ended):
    monkeypatch.setattr(fuzz.cli, "main", lambda words: does())
    assert fuzz.run(fuzz.Case("", (), {"config.yaml": b""}), limit=1).ended == ended


CHECK = load("checks/same_learning")


def test_every_layer_has_a_row_in_the_check_of_learning():
    there = {f"{folder}/{path.stem}" for folder in CHECK.FOLDERS for path in Path("configs", folder).glob("*.yaml")}
    assert there == CHECK.ROWS.keys() and len(there) > 30


@pytest.mark.parametrize("name", CHECK.ROWS)
def test_each_layer_changes_a_setting_of_the_task_on_which_it_is_compared(name):
    row = CHECK.ROWS[name]
    task = f"configs/{row.config}.yaml"
    without = loading.load(task, row.settings, layers=[f"configs/{layer}.yaml" for layer in row.below])
    layers = [f"configs/{layer}.yaml" for layer in (*row.below, name)]
    assert loading.load(task, row.settings, layers=layers) != without


@pytest.mark.parametrize(("fails", "code"), [(False, 0), (True, 1)])
def test_the_check_of_learning_goes_on_where_a_layer_is_new_or_a_command_fails(
    tmp_path, monkeypatch, capsys, fails, code
):
    def compare(old, new, name, place):
        if fails and name == "agents/gara":
            raise RuntimeError("its last words")
        return CHECK.Found("same")

    monkeypatch.setattr(CHECK, "compare", compare)
    (tmp_path / "configs" / "agents").mkdir(parents=True)
    for name in ("gara", "flat"):
        (tmp_path / "configs" / "agents" / f"{name}.yaml").touch()
    names = ["agents/gara", "agents/flat", "agents/hiro"]
    assert CHECK.compared(tmp_path, tmp_path, names, CHECK.Place(tmp_path, tmp_path), jobs=1) == code
    told = capsys.readouterr().out
    assert f"{2 - fails} same, 0 close, 0 differs, {int(fails)} fails, 1 new" in told
    assert ("its last words" in told) == fails


def test_the_check_of_learning_tells_a_bit_from_rounding_and_rounding_from_more():
    whole, real = np.arange(3), np.array([1.0, 1e-3, np.nan], np.float32)
    old = {"count": whole, "weight": real}
    for new, different, far in (
        ({}, 0, 0),
        ({"weight": real + np.float32(1e-7)}, 1, 0),
        ({"weight": real + np.float32(2e-5)}, 1, 1),
        ({"weight": np.array([1.0, 1e-3, 0.0], np.float32)}, 1, 1),
        ({"weight": -real}, 1, 1),
        ({"count": whole + 1}, 1, 1),
        ({"more": whole}, 1, 1),
    ):
        assert len(CHECK.bits(old, old | new)) == different
        assert len(CHECK.rounding(old, old | new)) == far


@pytest.mark.parametrize("loops", [0, 3])
def test_a_maze_has_its_loops_and_a_way_as_long_as_it_says(tmp_path, capsys, loops):
    script = load("results/mazes")
    files = [tmp_path / name for name in ("a.yaml", "again.yaml", "b.yaml")]
    for file, seed in zip(files, ("0", "0", "1"), strict=True):
        words = ["--seed", seed, "--rows", "4", "--loops", str(loops), "--way", "60", "90", "--out", str(file)]
        script.main(words)
    one, again, other = (file.read_text() for file in files)
    assert one == again != other
    rows = yaml.safe_load(one)["map"].split()
    free = {(r, c) for r, row in enumerate(rows) for c, symbol in enumerate(row) if symbol != "1"}
    joined = sum((r + dr, c + dc) in free for r, c in free for dr, dc in ((0, 1), (1, 0)))
    assert joined - len(free) + 1 == loops  # of one connected piece
    (start,), (goal,) = ([(r, c) for r, c in free if rows[r][c] == symbol] for symbol in "rg")
    steps, edge = {start: 0}, [start]
    for r, c in edge:  # grows as it is gone through
        for cell in ((r, c + 1), (r, c - 1), (r + 1, c), (r - 1, c)):
            if cell in free and cell not in steps:
                steps[cell] = steps[r, c] + 1
                edge.append(cell)
    assert steps.keys() == free and steps[goal] == max(steps.values())
    way = float(one.split()[1])  # cuts corners
    assert 60 <= way <= 90 and 0.7 * 4 * steps[goal] <= way <= 4 * steps[goal]
    assert envs.make("point_maze", map=str(files[0])).arena.cell == 4
    with pytest.raises(SystemExit, match="2"):
        script.main([*words, "--rows", "1", "--columns", "2"])
    assert capsys.readouterr().err == "error: --way: no maze of 1 x 2 rooms has one of 60 to 90 m\n"


def test_the_transcript_of_the_tutorial_is_what_its_commands_print(tmp_path):
    script = load("pages/tutorial")
    page = """Write `a.txt`.

```text title="a.txt"
one
```

```bash
cat a.txt; seq 20
```

```console
something old
```
"""
    made, seconds = script.told(page, tmp_path)
    last = "".join(f"{number}\n" for number in range(7, 21))
    assert made == page.replace("something old\n", f"...\n{last}") and script.told(made, tmp_path)[0] == made
    assert [command for command, _ in seconds] == ["cat a.txt; seq 20"]
    with pytest.raises(SystemExit, match="false: exit code 1"):
        script.told("```bash\nfalse\n```\n", tmp_path)
