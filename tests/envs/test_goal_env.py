"""Environments of a user's own: what is looked at, and how they behave once adapted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import envs
from envs._quiet import Env, State
from envs.goal_env import need


class Line(Env):
    """A point on a line from 0 to 10 that moves by its action; the state is its place and a clock."""

    state_dim, action_size, goal_indices = 2, 1, (0,)
    space, subgoal_scale = ((0.0,), (10.0,)), (2.0,)
    success_radius, episode_length = 0.5, 6
    observation_size, backend = 3, "jax"

    def reset(self, rng):
        return self.at(jnp.ones(()), jnp.zeros(()), jax.random.uniform(rng, minval=0.0, maxval=10.0))

    def step(self, state, action):
        place, clock = state.pipeline_state
        return self.at(place + action[0], clock + 1, state.obs[2])

    def at(self, place, clock, goal):
        distance = jnp.abs(place - goal)
        metrics = {"distance": distance, "success": (distance < 0.5).astype(jnp.float32)}
        return State((place, clock), jnp.stack([place, clock, goal]), -distance, self.over(place), metrics)

    def over(self, place):
        return jnp.zeros(())


def changed(**attributes):
    """`Line` with other attributes or methods."""
    return type("Changed", (Line,), attributes)()


def without(name):
    """`Line` that lacks an attribute."""
    raises = property(lambda self: object.__getattribute__(self, "_nothing"))
    return changed(**{name: raises})


def with_metrics(metrics):
    return lambda self, place, clock, goal: Line.at(self, place, clock, goal).replace(metrics=metrics(place))


def distance_only(place):
    return {"distance": place}


def doubled(self, state, action):
    after = Line.step(self, state, action)
    return after.replace(pipeline_state=(*after.pipeline_state, jnp.zeros(())))


def whole(self, state, action):
    after = Line.step(self, state, action)
    return after.replace(pipeline_state=(after.pipeline_state[0], jnp.zeros((), jnp.int32)))


def listed(self, state, action):
    after = Line.step(self, state, action)
    return after.replace(pipeline_state=list(after.pipeline_state))


def lost(self, state, action):
    return Line.step(self, state, action).replace(obs=jnp.full(3, jnp.nan))


def unpaid(self, state, action):
    after = Line.step(self, state, action)
    return after.replace(reward=jnp.where(action[0] == 0, after.reward, jnp.nan))


def leaves(self, rng):
    raise SystemExit(3)


def far(self, rng):
    return self.at(jnp.ones(()), jnp.zeros(()), jnp.asarray(11.0))


def broken(self, rng):
    raise RuntimeError("no such robot\nsecond line")


def half(self, rng):
    return jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16), Line.reset(self, rng))


WRONG = {
    "no state_dim": (without("state_dim"), "state_dim is missing; allowed: a whole number above 0"),
    "no action_size": (without("action_size"), "action_size is missing"),
    "no goal_indices": (without("goal_indices"), "goal_indices is missing"),
    "no space": (without("space"), "space is missing"),
    "no subgoal_scale": (without("subgoal_scale"), "subgoal_scale is missing"),
    "no success_radius": (without("success_radius"), "success_radius is missing"),
    "no episode_length": (without("episode_length"), "episode_length is missing"),
    "no step": (changed(step=None), "step is null; allowed: a method"),
    "float state_dim": (changed(state_dim=2.0), "state_dim is 2.0"),
    "true as a number": (changed(action_size=True), "action_size is true"),
    "no steps": (changed(episode_length=0), "episode_length is 0"),
    "goal out of the state": (changed(goal_indices=(2,)), "goal_indices is (2,); allowed: one or more different whole"),
    "goal twice": (changed(goal_indices=(0, 0)), "goal_indices is (0, 0)"),
    "text": (changed(goal_indices="0"), "goal_indices is '0'"),
    "abstract of another length": (changed(abstract_indices=(0, 1)), "space is"),
    "space upside down": (changed(space=((10.0,), (0.0,))), "space is"),
    "space without end": (changed(space=((0.0,), (np.inf,))), "space is"),
    "scale of another length": (changed(subgoal_scale=(1.0, 1.0)), "subgoal_scale is (1.0, 1.0); allowed: 1 numbers"),
    "radius of none": (changed(success_radius=-1), "success_radius is -1; allowed: a number above 0"),
    "three quarters of a quaternion": (changed(orientation=(0, 1, 0)), "orientation is (0, 1, 0)"),
    "velocity of one": (changed(velocity=(0,)), "velocity is (0,)"),
    "cuts of another length": (changed(region_cuts=((), ())), "region_cuts is ((), ()); allowed: 1 tuples"),
    "walls of three": (changed(walls=[[0, 1, 2]]), "walls is [[0, 1, 2]]; allowed: rectangles [n, 4]"),
    "another observation": (changed(state_dim=1), "obs of reset is float32 [3]; allowed: float32 [2]"),
    "half precision": (changed(reset=half), "obs of reset is bfloat16 [3]; allowed: float32 [3]"),
    "no success": (changed(at=with_metrics(distance_only)), "metrics of reset lack success"),
    "no state": (changed(reset=lambda self, rng: jnp.zeros(3)), "reset gives a"),
    "a leaf more": (changed(step=doubled), "step adds pipeline_state[2] to the state"),
    "a leaf of another type": (changed(step=whole), "step makes pipeline_state[1] int32 []; allowed: float32 []"),
    "a list for a tuple": (changed(step=listed), "step changes the structure of the state"),
    "not a number": (changed(step=lost), "obs of step with an action of zeros is not finite"),
    "rewards that are none": (changed(step=unpaid), "reward of all 64 steps with random actions is not finite"),
    "a pair": (changed(step=lambda self, state, action: (state, 0)), "step gives a tuple; allowed: a brax State"),
    "an exit": (changed(reset=leaves), "reset raises SystemExit: 3 (" + __file__),
    "goals outside": (changed(reset=far), "a goal of reset has 11 in abstract dimension 0; allowed: inside the space"),
    "an error": (changed(reset=broken), "reset raises RuntimeError: no such robot (" + __file__),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_missing_or_wrong_is_named_in_one_line(case):
    env, words = WRONG[case]
    with pytest.raises(envs.EnvError) as error:
        envs.adapt(env, name="mine:make")
    assert str(error.value).startswith(f"mine:make: {words}")
    assert "\n" not in str(error.value)


class Units:
    """What a state may hold that is no number: equal to others, with an address in its text, as in MJX's data."""

    def __eq__(self, other):
        return isinstance(other, Units)

    def __hash__(self):
        return 0


@struct.dataclass
class Place:
    place: jax.Array
    clock: jax.Array
    units: Units = struct.field(pytree_node=False)

    def __iter__(self):
        return iter((self.place, self.clock))


def with_units(self, place, clock, goal):
    return Line.at(self, place, clock, goal).replace(pipeline_state=Place(place, clock, Units()))


def test_structures_are_compared_not_their_texts():
    env = envs.adapt(changed(at=with_units), name="mine:units")
    assert env.step(env.reset(jax.random.key(0)), jnp.zeros(1)).obs.shape == (3,)


@pytest.fixture(scope="module")
def line():
    return envs.adapt(Line(), name="mine:line")


def steps(env, actions, *, key=0):
    """The states of an episode under `actions`, the first of them after the reset."""

    def one(state, action):
        return (after := env.step(state, action)), after

    first = jax.jit(env.reset)(jax.random.key(key))
    return first, jax.jit(lambda state: jax.lax.scan(one, state, jnp.asarray(actions)[:, None])[1])(first)


def test_what_is_not_given_has_a_default(line):
    assert (line.abstract_indices, line.region_cuts, line.orientation, line.velocity) == ((0,), ((),), (), ())
    assert (line.dt, line.engine, line.name, line.walls.shape) == (1.0, "auto", "mine:line", (0, 4))
    assert line.observation_size == 3


def test_an_episode_is_truncated_at_its_length_and_actions_are_clipped(line):
    first, states = steps(line, [5.0] + [0.0] * 6)
    np.testing.assert_array_equal(states.obs[:, 0], 2.0)  # 1 + 1, not 1 + 5
    np.testing.assert_array_equal(states.done, [0, 0, 0, 0, 0, 1, 1])
    np.testing.assert_array_equal(states.info["truncation"], states.done)
    np.testing.assert_array_equal(states.info["steps"], np.arange(1, 8))
    assert jax.tree.structure(first) == jax.tree.structure(states)


def test_the_tasks_own_end_is_no_truncation_and_what_has_ended_stays(line):
    ends = changed(over=lambda self, place: (place > 2.5).astype(jnp.float32))
    _, states = steps(envs.adapt(ends, name="mine:ends"), [1.0] * 6)
    np.testing.assert_array_equal(states.obs[:, 0], [2, 3, 3, 3, 3, 3])
    np.testing.assert_array_equal(states.done, [0, 1, 1, 1, 1, 1])
    np.testing.assert_array_equal(states.info["truncation"], 0.0)


def test_an_end_that_the_environment_calls_a_truncation_is_one():
    class Cut(Line):
        def at(self, place, clock, goal):
            cut = (place > 2.5).astype(jnp.float32)
            return super().at(place, clock, goal).replace(done=cut, info={"truncation": cut})

    _, states = steps(envs.adapt(Cut(), name="mine:cut"), [1.0] * 3)
    np.testing.assert_array_equal(states.done, [0, 1, 1])
    np.testing.assert_array_equal(states.info["truncation"], [0, 1, 1])


def test_a_step_that_is_not_finite_is_not_made_and_truncates():
    def fails(self, state, action):
        return jax.tree.map(
            lambda leaf: jnp.where(action[0] > 0.5, jnp.nan, leaf).astype(leaf.dtype), Line.step(self, state, action)
        )

    _, states = steps(envs.adapt(changed(step=fails), name="mine:fails"), [0.25, 0.25, 1.0, 0.25])
    np.testing.assert_array_equal(states.obs[:, 0], [1.25, 1.5, 1.5, 1.5])
    np.testing.assert_array_equal(states.metrics["non_finite"], [0, 0, 1, 0])
    np.testing.assert_array_equal(states.done, [0, 0, 1, 1])
    np.testing.assert_array_equal(states.info["truncation"], [0, 0, 1, 1])
    assert np.isfinite(states.reward).all()
    assert (states.reward[:2] != 0).all() and (states.reward[2:] == 0).all()  # nothing was done for more


def test_a_state_may_hold_numbers_of_python():
    def paid(self, state, action):
        return Line.step(self, state, action).replace(done=0.0)

    _, states = steps(envs.adapt(changed(step=paid), name="mine:paid"), [1.0, 1.0])
    np.testing.assert_array_equal(states.obs[:, 0], [2.0, 3.0])


def test_a_batch_starts_new_episodes_by_itself(line):
    batch = envs.VectorEnv(line, 3)
    state = jax.jit(batch.reset)(jax.random.key(1))
    goals = state.obs[:, 2]
    step = jax.jit(batch.step)
    for _ in range(6):
        state = step(state, jnp.full((3, 1), 0.5))
    np.testing.assert_array_equal(state.done, 1.0)
    np.testing.assert_array_equal(state.info["final_obs"][:, 0], 4.0)
    np.testing.assert_array_equal(state.obs[:, 0], 1.0)
    assert (state.obs[:, 2] != goals).all()


def test_a_feature_says_what_it_lacks(line):
    need(envs.make("point_maze"), "star render", "model", "pose", "arena")
    with pytest.raises(envs.EnvError, match="mine:line has no with_goal, which SGIM needs"):
        need(line, "SGIM", "with_goal")


def test_another_goal_is_set_by_the_environment_itself():
    def with_goal(self, state, goal):
        return self.at(*state.pipeline_state, goal[0])

    env = envs.adapt(changed(with_goal=with_goal), name="mine:set")
    state = env.with_goal(env.reset(jax.random.key(0)), jnp.asarray([7.0]))
    assert (float(state.obs[2]), float(state.metrics["distance"])) == (7.0, 6.0)
