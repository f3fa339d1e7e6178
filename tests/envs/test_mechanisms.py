"""Gates, blocks and gaps: bodies dragged along a scripted path by their velocity."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from tests.made import jitted, made


@cache
def dragged(env):
    """An env step of `env` whose body has the given velocity before it, compiled."""
    name = "qvel" if env.name.startswith("ant") else "velocity"

    @jax.jit
    def step(state, velocity):
        data = state.pipeline_state.data
        data = data.replace(**{name: getattr(data, name).at[:2].set(velocity)})
        state = state.replace(pipeline_state=state.pipeline_state.replace(data=data))
        return env.step(state, jnp.zeros(env.action_size) if name == "qvel" else velocity / 4.0)

    return step


class Scripted:
    """An environment whose body is dragged: its velocity in the plane is overwritten before every env step."""

    def __init__(self, name, **options):
        self.env = made(name, goals="test", **options)
        self.ant = name.startswith("ant")
        self.state = jitted(self.env.reset)(jax.random.key(0))
        self._step = dragged(self.env)
        self.seen = []

    def put(self, **values):
        """Overwrite parts of the data: qpos={index: value}."""
        data = self.state.pipeline_state.data
        for name, parts in values.items():
            leaf = np.array(getattr(data, name))
            leaf[[*parts]] = [*parts.values()]
            data = data.replace(**{name: leaf})
        self.state = self.state.replace(pipeline_state=self.state.pipeline_state.replace(data=data))

    def drag(self, velocity, steps=1):
        for _ in range(steps):
            self.state = self._step(self.state, np.asarray(velocity, np.float32))
            self.seen.append(float(self.state.metrics["success"]))

    def go(self, *place, speed=3.0, steps=80, until=None):
        """Drag the body to `place`, or until something holds; whether that came about."""
        for _ in range(steps):
            away = np.array(place) - self.position[:2]
            if until() if until else np.linalg.norm(away) < 0.4:
                return True
            self.drag(speed * away / np.linalg.norm(away))
        return False

    @property
    def position(self):
        return np.asarray(self.state.obs)[:3]

    @property
    def block(self):
        return np.asarray(self.state.pipeline_state.data.qpos)[15:]


def test_a_pushed_block_falls_into_the_gap_and_bears_the_ant_to_the_goal():
    fall = Scripted("ant_fall")
    fall.drag((0, 0), steps=10)
    np.testing.assert_allclose(fall.block, 0.0, atol=1e-3)  # it rests
    assert fall.go(8.0, 0.0)
    assert fall.go(8.0, 12.0, until=lambda: fall.block[0] > 7.97)  # it slides
    assert fall.go(8.0, 9.0)
    fall.drag((0, 0), steps=20)
    assert fall.block[1] == pytest.approx(-4.0, abs=0.02)  # it fell
    assert fall.go(8.0, 16.0)
    fall.drag((0, 0), steps=20)
    assert fall.position[2] > 4.25 and fall.block[1] == pytest.approx(-4.0, abs=0.02)  # it bears the ant
    assert not any(fall.seen)
    assert fall.go(8.0, 24.0) and fall.go(0.5, 25.0)
    assert fall.seen[-1] == 1.0


def test_a_block_that_is_pushed_on_at_the_end_of_its_way_stays_there_and_falls():
    fall = Scripted("ant_fall")
    fall.go(8.0, 0.0)
    way = []
    fall.go(8.0, 12.5, until=lambda: way.append(fall.block) or fall.block[1] < -0.5)
    assert 7.9 < max(y for y, _ in way) < 8.05
    assert way[-1][1] < -0.5


def test_who_steps_into_the_gap_stays_there_and_never_succeeds():
    fall = Scripted("ant_fall")
    fall.go(0.0, 16.0, steps=80)
    assert fall.position[2] < 1.5
    for x, y in ((0.0, 27.0), (4.0, 27.0), (11.0, 27.0), (0.0, 0.0)):
        assert not fall.go(x, y, speed=6.0, steps=40)
        assert fall.position[2] < 2.5 and 11.0 < fall.position[1] < 20.0
    assert not any(fall.seen)


def test_a_block_pushed_aside_opens_the_way_and_one_pushed_ahead_closes_it():
    push = Scripted("ant_push")
    push.drag((0, 0), steps=10)
    np.testing.assert_allclose(push.block, 0.0, atol=1e-3)
    assert push.go(-8.0, 0.0) and push.go(-8.0, 8.0)
    assert push.go(4.0, 8.0, until=lambda: push.block[0] > 7.5)
    assert push.go(0.0, 8.0) and push.go(0.0, 18.5)
    assert push.seen[-1] == 1.0

    ahead = Scripted("ant_push")
    assert not ahead.go(0.0, 19.0)
    assert not any(ahead.seen) and ahead.block[1] > 7.0


YAW = {yaw: (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)) for yaw in (-2.0, -1.01, -0.99, -0.5, -0.01, 0.01, 1.0)}


@pytest.fixture(scope="module")
def cam():
    env = made("ant_maze_cam", observe="full", goals="test")
    return env, jitted(env.reset)(jax.random.key(0)), jitted(env.step)


@pytest.mark.parametrize(
    ("x", "y", "yaw", "opens"),
    [
        (18.0, 0.0, -0.5, True),
        (16.1, 2.0, -0.99, True),
        (18.0, -3.0, -0.01, True),
        (15.9, 0.0, -0.5, False),
        (18.0, 0.0, 0.01, False),
        (18.0, 0.0, -1.01, False),
        (18.0, 0.0, -2.0, False),
        (18.0, 0.0, 1.0, False),
        (18.0, 14.0, -0.5, False),
    ],
)
def test_the_gate_of_the_ant_opens_exactly_on_its_condition(cam, x, y, yaw, opens):
    env, state, step = cam
    data = state.pipeline_state.data
    qpos = np.array(data.qpos)
    qpos[:7] = x, y, 3.0, *YAW[yaw]
    data = data.replace(qpos=qpos, qvel=np.zeros_like(data.qvel))
    after = step(state.replace(pipeline_state=state.pipeline_state.replace(data=data)), np.zeros(8, np.float32))
    assert bool(np.asarray(after.obs)[30] > 0) == opens


@pytest.mark.parametrize("name", ["ant_maze_cam", "point_maze_cam"])
def test_a_closed_gate_bars_the_way_and_an_open_one_stays_open(name):
    cam = Scripted(name, observe="full")
    flag = cam.env.state_dim - 1
    assert cam.go(12.0, 0.0)
    if cam.ant:  # turned away from the switch, to the far side of it
        cam.put(qpos={2: 0.9, 3: np.cos(0.5), 4: 0.0, 5: 0.0, 6: np.sin(0.5)})
    assert not cam.go(12.2, 16.0, steps=40)
    assert cam.position[1] < 4.0 and np.asarray(cam.state.obs)[flag] == 0.0
    if cam.ant:
        cam.put(qpos={0: 18.0, 1: 0.0, 2: 0.9, 3: np.cos(-0.25), 4: 0.0, 5: 0.0, 6: np.sin(-0.25)})
        cam.drag((0.0, 0.0))
    else:
        assert cam.go(17.0, 0.0)
    assert np.asarray(cam.state.obs)[flag] == 1.0
    assert cam.go(16.0, 16.0) and cam.go(2.0, 16.0)
    assert cam.seen[-1] == 1.0 and np.asarray(cam.state.obs)[flag] == 1.0


@pytest.mark.parametrize("name", ["ant_maze_cam", "point_maze_cam"])
def test_random_actions_never_pass_a_closed_gate(name):
    env = made(name, observe="full", goals="test")
    vector = envs.VectorEnv(env, 64, auto_reset=False)

    @jax.jit
    def play(key):
        def step(state, key):
            action = jax.random.uniform(key, (64, env.action_size), minval=-1, maxval=1)
            state = vector.step(state, action)
            return state, (state.obs, state.metrics["success"])

        return jax.lax.scan(step, vector.reset(key), jax.random.split(key, env.episode_length))[1]

    obs, success = play(jax.random.key(0))
    shut = obs[..., env.state_dim - 1] == 0
    assert shut.mean() > 0.9
    assert not ((obs[..., 1] > 4.0) & shut).any()
    assert not success[shut].any()
