"""Demonstrations of agents: the file holds what happened, and doing the same again leads to the same."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.point import PointState
from star import cli
from star.agent import demonstrations, environment
from star.agent.demonstrations import Moments
from star.config.loading import load
from star.sgim import teachers
from star.spec import Spec

PERIOD = 20
EPISODES = 200


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    """What is said of the second agent's episodes, the demonstrations in the file, and the training environment."""
    out = tmp_path_factory.mktemp("recorded") / "demos.npz"
    config = load(run / "config.yaml")
    said = demonstrations.record(config, run, out, episodes=EPISODES, agent=6, seed=1, quiet=True)
    env = environment.make(config, "train")
    return said, jax.tree.map(np.asarray, teachers.load(out, env="point_maze", spec=Spec.of(env))), env


def test_it_is_said_how_many_episodes_are_shown(recorded):
    said, demos, _ = recorded
    assert 5 < len(demos.starts) < EPISODES
    many = f": {len(demos.starts)} of {EPISODES} episodes reach their goal, in {np.median(demos.lengths):g} env steps"
    assert many in said


def test_doing_what_was_done_leads_where_it_led(recorded):
    _, demos, env = recorded

    def again(state, actions):
        start = PointState(position=state[:2], velocity=state[2:], open=jnp.zeros(()))
        step = lambda data, action: (moved := env.body.step(data, action), env.body.observe(moved, 0))  # noqa: E731
        return jax.lax.scan(step, start, actions)[1]

    states = np.asarray(jax.jit(jax.vmap(again))(demos.states[:, 0], demos.actions))
    for n, length in enumerate(demos.lengths):
        np.testing.assert_allclose(states[n, :length], demos.states[n, 1 : length + 1], atol=1e-4)
        assert (demos.states[n, length:] == demos.states[n, length]).all()
        assert (demos.actions[n, length:] == 0).all() and demos.actions[n, :length].any(axis=-1).all()


def test_a_demonstration_leads_from_start_to_outcome_past_where_the_commander_decided(recorded):
    _, demos, env = recorded
    position = demos.states[..., :2]
    np.testing.assert_array_equal(demos.starts, position[:, 0])
    np.testing.assert_array_equal(demos.outcomes, position[:, -1])
    assert (np.abs(demos.starts) <= 0.1).all() and (demos.lengths > PERIOD).any() and (demos.lengths < PERIOD).any()
    for n, length in enumerate(demos.lengths):
        for stop, waypoint in enumerate(demos.waypoints[n], start=1):
            np.testing.assert_array_equal(waypoint, position[n, min(stop * PERIOD, length)])


def moments(success):
    """Two env steps of episodes whose successes at three moments are given, one row for each episode."""
    success = np.asarray(success, np.float32).T
    obs = np.arange(success.size * 6, dtype=np.float32).reshape(*success.shape, 6)
    return Moments(obs=obs, success=success, action=np.full((*success.shape, 2), 2, np.float32))


def test_an_episode_is_shown_up_to_its_first_success_and_only_if_there_was_something_to_do(recorded):
    spec = Spec.of(recorded[2])
    seen = moments([[0, 0, 0], [0, 1, 0], [1, 1, 1], [0, 0, 1]])
    demos = demonstrations.demonstrations(seen, spec, period=1)
    assert demos.lengths.tolist() == [1, 2]
    np.testing.assert_array_equal(demos.outcomes, [seen.obs[1, 1, :2], seen.obs[2, 3, :2]])
    assert demos.actions[..., 0].tolist() == [[1, 0, 0], [1, 1, 0]], "as strong as actions can be, none at the end"
    assert demonstrations.demonstrations(moments([[0, 0, 0], [1, 1, 1]]), spec, period=1) is None


@pytest.fixture
def played(monkeypatch, recorded):
    """Makes `record.play` return what it is given, and notes how it was asked."""
    asked = []

    def prepare(seen):
        def play(config, run_dir, **how):
            asked.append((config.env.name, run_dir, how))
            return seen, Spec.of(recorded[2])

        monkeypatch.setattr(demonstrations, "play", play)
        return asked

    return prepare


def test_the_command_plays_what_it_is_asked_for_and_replaces_a_file_only_by_force(run, played, tmp_path, capsys):
    asked = played(moments([[0, 1, 1], [0, 0, 0]]).replace(obs=np.zeros((3, 2, 6))))
    out = tmp_path / "demos.npz"
    arguments = f"record {run} --out {out} --episodes 2 --checkpoint 160 --evaluation-seed 9 --seed 6 --quiet".split()
    assert cli.main(arguments) == 0
    how = {"checkpoint": "160", "agent": 6, "episodes": 2, "seed": 9}
    assert asked == [("point_maze", run, how)]
    assert capsys.readouterr() == (f"{out}: 1 of 2 episodes reach their goal, in 1 env steps (median)\n", "")
    before = out.read_bytes()
    assert cli.main(arguments) == 2 and len(asked) == 1
    assert "exists; replace it with --force" in capsys.readouterr().err
    assert cli.main([*arguments, "--force"]) == 0 and out.read_bytes() == before


def test_where_no_episode_reaches_its_goal_nothing_is_written(run, played, tmp_path, capsys):
    played(moments([[0, 0, 0]]))
    assert cli.main(["record", str(run), "--out", str(tmp_path / "demos.npz"), "--episodes", "1"]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"error: {run}: none of 1 episodes reaches its goal, there is nothing to show\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--seed 7", "--seed: 7 is not among those of"),
        ("--checkpoint 7", "--checkpoint: '7' is not among last, best, 160"),
        ("--tutor.ppo.hidden [16]", "its checkpoint was made with tutor.ppo.hidden"),
    ],
)
def test_what_cannot_be_recorded_is_told_in_one_line_and_nothing_is_written(run, tmp_path, capsys, arguments, said):
    assert cli.main(["record", str(run), "--out", str(tmp_path / "a.npz"), *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert said in err and err.count("\n") == 1 and out == "" and not list(tmp_path.iterdir())
