"""`star.load`, `star.train` and `star.evaluate`: the same numbers as those of the commands."""

import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import gymnasium
import jax
import numpy as np
import pytest

import envs
import star
from envs.common.errors import UserError
from star import cli
from star.agent import play
from star.agent.slim import slim
from star.config.loading import load_to_act, parse
from star.training import checkpoint
from star.training import program as programs
from tests.small import ALONE, RUN

EPISODES, STEPS = 3, 40  # as in conftest.UNTRAINED
GOAL = (4, 6)  # where the goal is in an observation


@pytest.fixture(scope="module")
def agent(run):
    return star.load(run, seed=6)


@pytest.fixture(autouse=True)
def rested(agent):
    agent.reset()


@cache
def evaluated(run, episodes):
    """Observations and actions [seeds, env steps, episodes, ...] of `star evaluate`."""
    program = programs.build(load_to_act(run, {}))
    spec, states = program.experiment.tested_spec, checkpoint.load_state(program, run, "last")[1]
    vector = envs.VectorEnv(program.experiment.test_env, episodes, auto_reset=False)

    def one(state, key):
        kept = play.greedy(program.hyper, spec, vector, state, record=lambda env, *_: (env.obs, _[-1]), key=key)[1]
        return kept

    keys = program.evaluation_keys(0, stream=programs.AFTERWARDS)
    return jax.device_get(jax.jit(jax.vmap(one))(states, keys))


@pytest.mark.parametrize("episodes", [1, EPISODES])
def test_it_acts_as_in_the_episodes_of_star_evaluate_bit_for_bit(run, agent, episodes):
    obs, actions = (leaf[1] for leaf in evaluated(run, episodes))
    for shape in [slice(None)] if episodes > 1 else [slice(None), 0]:  # a batch of one, and one by itself
        agent.reset()
        acted = np.stack([agent.act(one[shape]) for one in obs])
        np.testing.assert_array_equal(acted, np.clip(actions, -1, 1)[:, shape])
    assert len(acted) == STEPS and np.abs(np.diff(acted, axis=0)).max() > 0.1


def test_a_slim_agent_acts_as_the_whole_one_and_holds_no_more_than_that_takes(run, agent):
    obs = evaluated(run, EPISODES)[0][1]
    whole = np.stack([agent.act(one) for one in obs])
    state = agent._state
    agent._state = slim(agent.config.hyper(), state)
    try:
        agent.reset()
        np.testing.assert_array_equal(np.stack([agent.act(one) for one in obs]), whole)
        for level in (agent._state.tutor, agent._state.controller):
            assert not any(leaf.any() for leaf in jax.tree.leaves((level.optimizer, level.params["critic"])))
        assert not agent._state.forward_model.ring.experience.start.any()
    finally:
        agent._state = state


def test_an_agent_of_the_package_is_loaded_by_its_name_unless_there_is_a_folder_of_this_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert star.load("point_maze").config.env.name == "point_maze"
    with pytest.raises(UserError, match=r"^point_mase: .* \(did you mean point_maze\?\)$"):
        star.load("point_mase")
    (tmp_path / "point_maze").mkdir()
    with pytest.raises(UserError, match="^point_maze: is not a run directory"):
        star.load("point_maze")


def test_the_seed_of_an_episode_decides_between_commands_of_equal_worth_and_how_to_move_on(agent):
    still, state = np.zeros((STEPS, agent.observation_size)), agent._state
    still[:, slice(*GOAL)] = 8.0
    walking = still + np.arange(STEPS)[:, None] * np.eye(agent.observation_size)[0]

    def acted(seed, seen):
        agent.reset(seed)
        return np.stack([agent.act(obs) for obs in seen])

    def different(seen=walking):
        return len({acted(seed, seen).tobytes() for seed in range(5)})

    assert different() > 1
    np.testing.assert_array_equal(acted(1, walking), acted(1, walking))
    model = state.commander.model
    told = model.replace(rewards=np.zeros_like(model.rewards), visits=np.full_like(model.visits, 1e6))
    told.rewards[..., 0] = 1e6  # to be sent to region 0 pays
    agent._state = state.replace(commander=state.commander.replace(model=told))
    try:
        assert different() == 1
        first = still[: agent.config.commander.period]  # later on there is another target
        assert different(first) > 1  # who stands still acts with noise
    finally:
        agent._state = state


def test_it_plays_in_a_gymnasium_loop_and_says_when_reset_was_forgotten(agent):
    env = gymnasium.make("star/PointMaze-v0", goals="test", episode_length=STEPS)
    obs, _ = env.reset(seed=0)
    truncated = False
    while not truncated:
        action = agent.act(obs)
        assert env.action_space.contains(action)
        obs, _, _, truncated, _ = env.step(action)
    with pytest.raises(UserError, match=r"^obs: the episode of 40 env steps is over; agent.reset\(\) begins another$"):
        agent.act(env.reset(seed=1)[0])
    agent.reset()
    flat = np.concatenate([obs["observation"], obs["desired_goal"]])
    both = agent.act(obs)
    agent.reset()
    np.testing.assert_array_equal(agent.act(flat.astype(np.float64)), both)


def test_its_environment_is_the_task_of_its_run_with_test_goals(run, agent, monkeypatch):
    env, trained = agent.env(), agent.env(goals="train", episode_length=7)
    maze = programs.build(load_to_act(run, {})).experiment.test_env
    assert env.maze.episode_length == maze.episode_length == STEPS and trained.maze.episode_length == 7
    np.testing.assert_array_equal(env.maze.walls, maze.walls)
    goals = [{tuple(one.reset(seed=seed)[0]["desired_goal"]) for seed in range(3)} for one in (env, trained)]
    assert [len(each) for each in goals] == [1, 3]
    obs, info = env.reset(seed=0)
    assert not info["is_success"] and env.action_space.contains(agent.act(obs))
    config = parse(agent.config.model_dump(mode="json"), {"env.options.goals": "train", "env.options.cell": 6})
    monkeypatch.setattr(agent, "_program", replace(agent._program, config=config))  # an option of its run
    told = [tuple(agent.env().reset(seed=seed)[0]["desired_goal"]) for seed in (0, 1)]
    assert told[0] == told[1] and agent.env().maze.arena.cell == 6
    with pytest.raises(UserError, match='^option "gaols" .* did you mean "goals"'):
        agent.env(gaols="train")


@pytest.mark.parametrize(
    ("obs", "said"),
    [
        (np.zeros(5), r"obs: its shape is \(5,\); allowed: \(6,\) or \(B, 6\), the state, then the goal"),
        (np.zeros((2, 3, 6)), r"obs: its shape is \(2, 3, 6\)"),
        (np.zeros((0, 6)), r"obs: its shape is \(0, 6\)"),
        (np.array([[0.0] * 6, [0, 0, np.nan, 0, 0, 0]]), r"obs: entry \[1, 2\] is nan; allowed: finite numbers"),
        (np.full(6, 1e39), r"obs: entry \[0\] is inf"),
        ("state", r"obs: is no array of numbers; allowed: shape \(6,\) or \(B, 6\)"),
        (3.0, r"obs: is no array"),
        ({"observation": np.zeros(4)}, r"obs: has no 'desired_goal'"),
    ],
)
def test_what_no_agent_can_see_is_told_in_one_line(agent, obs, said):
    with pytest.raises(UserError, match=f"^{said}"):
        agent.act(obs)


def test_a_batch_keeps_its_size_until_the_next_reset(agent):
    assert agent.act(np.zeros((2, 6))).shape == (2, 2)
    with pytest.raises(UserError, match="obs: of 3, but the episode began with 2"):
        agent.act(np.zeros((3, 6)))
    agent.reset()
    assert agent.act(np.zeros((3, 6))).shape == (3, 2)


def test_its_regions_are_boxes_that_fill_the_space(agent):
    lower, upper = agent.regions
    assert lower.shape == upper.shape == (len(lower), 2) and len(lower) >= 2
    space = np.diff(agent.spec.space, axis=0)
    assert np.prod(upper - lower, axis=1).sum() == pytest.approx(np.prod(space))


def test_it_draws_itself(agent, can_draw, tmp_path):
    said = agent.render(tmp_path / "end.png", height=40, steps=2)
    assert (tmp_path / "end.png").stat().st_size > 100 and said.startswith(f"{tmp_path / 'end.png'}: 1 picture; ")
    with pytest.raises(UserError, match="exists"):
        agent.render(tmp_path / "end.png")
    with pytest.raises(UserError, match="cannot tell what to write"):
        agent.render(tmp_path / "end.doc")


READER = """
import sys, jax, numpy as np
from pathlib import Path

program, data, out = sys.argv[1:]
controller = jax.export.deserialize(bytearray(Path(program).read_bytes()))
given = np.load(data)
np.save(out, controller.call(given["obs"], given["subgoal"]))
assert not {"star", "envs", "flax", "brax"} & {name.partition(".")[0] for name in sys.modules}
"""


def test_its_controller_is_read_back_by_jax_alone(agent, tmp_path):
    obs = np.random.default_rng(0).normal(size=(STEPS, 3, 6)).astype(np.float32).cumsum(axis=0)
    acted = [(agent.act(one), agent.subgoal) for one in obs]
    actions, subgoals = (np.concatenate(each) for each in zip(*acted, strict=True))
    assert agent.subgoal.shape == (3, 2) and np.abs(np.diff(actions, axis=0)).max() > 0.1
    agent.export(tmp_path / "controller.stablehlo")
    np.savez(tmp_path / "given.npz", obs=obs.reshape(-1, 6), subgoal=subgoals)
    paths = [str(tmp_path / name) for name in ("controller.stablehlo", "given.npz", "actions.npy")]
    libraries = os.pathsep.join(path for path in sys.path if path and Path(path).resolve() != Path(__file__).parents[2])
    here = {**os.environ, "PYTHONPATH": libraries}
    subprocess.run([sys.executable, "-c", READER, *paths], cwd=tmp_path, env=here, check=True)
    np.testing.assert_allclose(np.load(tmp_path / "actions.npy"), actions, atol=1e-5)
    with pytest.raises(UserError, match="exists"):
        agent.export(tmp_path / "controller.stablehlo")
    with pytest.raises(UserError, match="allowed endings: .stablehlo"):
        agent.export(tmp_path / "controller.onnx")
    agent.reset()
    assert agent.subgoal is None


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"checkpoint": 7}, "'7' is not among last, best, 160"),
        ({"seed": 9}, "9 is not among those of .*: 5, 6"),
    ],
)
def test_an_agent_that_is_not_there_is_told_in_one_line(run, how, said):
    with pytest.raises(UserError, match=said):
        star.load(run, **how)


def test_no_run_is_told_in_one_line(tmp_path):
    for function in (star.load, star.evaluate):
        with pytest.raises(UserError, match=r"new: is not a run directory, there is nothing of this name$"):
            function(tmp_path / "new")


@pytest.mark.parametrize("function", [star.load, star.evaluate])
@pytest.mark.parametrize("given", [5, None, ["runs"], b"runs"])
def test_what_names_no_run_is_told_in_one_line(function, given):
    with pytest.raises(UserError, match=r"^run: .* is not allowed: should be the folder of a run, or the name of an"):
        function(given)


@pytest.mark.parametrize(
    ("config", "settings", "line"),
    [
        ([1], None, "config: [1] is not allowed: should be a name, a file, or a mapping of sections"),
        (None, None, "config: null is not allowed"),
        ({3: 2}, None, "config: {3: 2} is not allowed"),
        ("point_maze", ["trainer.seed"], "settings: ['trainer.seed'] is not allowed: should be a mapping of dotted"),
        ("point_maze", {3: 2}, "settings: {3: 2} is not allowed"),
        (b"point_maze", None, "config: b'point_maze' is not allowed"),
    ],
)
def test_settings_that_are_none_are_told_in_one_line(tmp_path, monkeypatch, config, settings, line):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=f"^{re.escape(line)}"):
        star.train(config, settings)
    if settings:
        with pytest.raises(UserError, match=f"^{re.escape(line)}"):
            star.evaluate("point_maze", settings)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("undrawn")
def test_training_and_evaluating_return_what_the_commands_print(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    result = star.train(ALONE, {"trainer.total_env_steps": 480})
    measure = "success_final"
    assert result.keys() == {"run", "env_steps", measure, "interrupted", "fault"}
    assert (result["env_steps"], result["interrupted"], result["fault"]) == (480, False, None)
    folder = Path(result["run"])
    assert folder.parent == Path("runs") and folder.name.startswith("point_maze-")
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert result[measure] == rows[-1][f"eval/{measure}"]
    row = star.evaluate(folder, {"trainer.eval_episodes": 2}, checkpoint=480, seed=4)
    capsys.readouterr()
    words = ["--json", "--episodes", "2", "--checkpoint", "480", "--evaluation-seed", "4"]
    assert cli.main(["evaluate", str(folder), *words]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(row)) and row["episodes"] == 2
    (tmp_path / "small.yaml").write_text(json.dumps(RUN))
    with pytest.raises(UserError, match=r"^settings: tutor.perod: unknown key \(did you mean tutor.period\?\)"):
        star.train("small.yaml", {"tutor.perod": 5})
    with pytest.raises(UserError, match="is not empty"):
        star.train("small.yaml", run_dir=folder)
    with pytest.raises(UserError, match="'all' is not allowed"):
        star.evaluate(folder, checkpoint="all")
    for seed in (-1, 2**31, 0.5):
        with pytest.raises(UserError, match=r"is not a whole number from 0 to 2\^31 - 1"):
            star.evaluate(folder, seed=seed)
    assert [path.name for path in Path("runs").iterdir()] == [folder.name]


def test_importing_the_package_is_quick_and_loads_neither_jax_nor_pydantic():
    code = "import sys, star; print(*star.__all__, *{'jax', 'numpy', 'pydantic', 'star.api'} & set(sys.modules))"
    begun = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["evaluate", "load", "train"] and time.perf_counter() - begun < 5
    with pytest.raises(AttributeError, match="module 'star' has no attribute 'lode'"):
        _ = star.lode
