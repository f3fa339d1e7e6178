"""A trained agent that acts from observations: the greedy agent of `star evaluate`, moved by whoever has the body.

It calls the functions of `hierarchy` that greedy episodes of `play` consist of, so that on a CPU the same observations
lead to the same actions, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, Float, Key

from envs.common import files, plugins
from envs.common.errors import UserError
from star.agent import commands, environment, hierarchy, levels
from star.agent.decisions import Memory, Roadmap
from star.agent.sections import AgentConfig, Config
from star.agent.state import TrainState
from star.config.loading import load_to_act
from star.spec import Spec
from star.training import checkpoint as saved
from star.training import program as programs
from star.training.program import Program

EXPORTED = ".stablehlo"  # the ending of an exported Controller
_DICT = ("observation", "desired_goal")  # of what Gymnasium's environments show, what an agent sees


class Regions(NamedTuple):
    """The n regions of an agent: boxes [lower, upper), in units of the state. There are none without a Commander."""

    lower: Float[np.ndarray, "n d"]
    upper: Float[np.ndarray, "n d"]


@dataclass
class _Episode:
    """State of the hierarchy in the episodes of B bodies, after `steps` env steps.

    `explore` is True for those whose actions have noise, `plan` what the Controller has decided for the next env steps.
    `before` is the last observation [B, n], and `shape` its leading axes as they were given: [] or [B].
    """

    state: TrainState
    roadmap: Roadmap
    memory: Memory
    keys: Array
    explore: Any = False
    subgoal: Any = None
    plan: Any = None
    before: Any = None
    steps: int = 0
    shape: tuple[int, ...] = ()


class TrainedAgent:
    """The greedy agent of one seed of a run; see `star.load`."""

    def __init__(self, program: Program, state: TrainState, *, run_dir: Path, env_steps: int, seed: int) -> None:
        self._program, self._state, self._run_dir = program, state, run_dir
        self.env_steps = env_steps
        """Those of its checkpoint."""
        self.seed = seed
        """The one that it was trained with."""
        self.spec: Spec = program.experiment.tested_spec
        """Its knowledge of the task: sizes, and which entries of the state positions and goals are."""
        self._episode: _Episode | None = None
        self.reset()

    @property
    def config(self) -> Config:
        """The settings of its run."""
        return self._program.config

    @property
    def observation_size(self) -> int:
        """Length n of an observation: the state, then the goal."""
        return self.spec.state_dim + len(self.spec.goal_indices)

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self.spec.action_size

    @property
    def regions(self) -> Regions:
        """The regions that its Commander chooses from."""
        found, count = self._state.abstraction, int(self._state.abstraction.count)
        count *= self.config.commander.enabled
        return Regions(np.asarray(found.lower[:count]), np.asarray(found.upper[:count]))

    def reset(self, seed: int = 0) -> None:
        """Begin an episode with the next observation.

        `seed` is the `--evaluation-seed` of `star evaluate`: it decides between commands of equal worth,
        and how an agent that stands still moves on.
        """
        keys = self._program.evaluation_keys(seed, stream=programs.AFTERWARDS)
        self._key, self._episode = keys[self._program.seeds.index(self.seed)], None

    def act(self, obs: Any) -> Float[np.ndarray, "*batch act"]:
        """The action for an observation [n], or the actions for those [B, n] of B bodies; in [-1, 1].

        `obs` may be what Gymnasium's environments show, too: a mapping with `observation` and `desired_goal`. The
        agent remembers the episode: call it once an env step, and `reset` before the next episode. All bodies of a
        batch begin together, and it acts as in `star evaluate --episodes B`.

        Raises:
          UserError: in one line, for another shape, what is not finite, or after the last env step of the episode.
        """
        given = _as_array(obs, self.observation_size)
        batch = given.reshape(-1, self.observation_size)
        episode = self._episode = self._episode or self._begun(batch)
        self._check(episode, batch)
        segment, within = divmod(episode.steps, self.config.tutor.period)
        spec, hyper = self.spec, self._program.hyper
        if within == 0:
            episode.memory, episode.explore, episode.subgoal, action, episode.plan = _decide(
                spec, hyper, episode.state, episode.roadmap, episode.memory, batch, episode.keys[segment]
            )
        else:
            episode.subgoal, action, episode.plan = _go_on(
                spec,
                hyper,
                episode.state,
                episode.subgoal,
                episode.before,
                batch,
                episode.plan,
                within,
                episode.explore,
                episode.keys[segment],
            )
        episode.before, episode.steps = batch, episode.steps + 1
        episode.shape = given.shape[:-1]
        return np.clip(np.asarray(action), -1.0, 1.0).reshape(*episode.shape, -1)

    def env(self, **options: Any) -> Any:
        """Its task as an `envs.gym.GymEnv` with test goals and the options of its run; `options` go before these.

        Raises:
          UserError: in one line, for an environment of the user's own, or a wrong option.
        """
        section = self.config.env
        if plugins.is_plugin(section.name):
            raise UserError(f"env: {section.name} is an environment of your own: make it, and give its obs to act")
        from envs.gym import GymEnv  # it imports what acting alone does not need

        return GymEnv(
            section.name, **{"engine": section.engine} | environment.options_of(self.config, "test") | options
        )

    def render(self, path: str | Path, *, force: bool = False, **how: Any) -> str:
        """Write a picture or a film of a test episode, and return a line about it; the ending of `path` decides.

        `how` are fields of `star.agent.films.Show`, as `steps`, `every`, `fps`, `camera` and `height`. Begins no
        episode of `act`. Raises `UserError` in one line if it cannot be drawn.
        """
        from star.agent import films  # drawing needs OpenGL, acting does not

        commands.check_output(Path(path), force=force)
        show = films.Show(out=Path(path), **how)
        return films.render(
            self.config,
            show,
            run_dir=self._run_dir,
            checkpoint=str(self.env_steps),
            agent=self.seed,
            quiet=True,
        )

    @property
    def subgoal(self) -> Float[np.ndarray, "*batch m"] | None:
        """The Controller's aim after the last `act`, relative to the body; None before the first.

        Points are displacements [p] in units of the state. Without a Tutor it is the lower and the upper corner [2d]
        of the target box.
        """
        if self._episode is None or self._episode.subgoal is None:
            return None
        return np.asarray(self._episode.subgoal).reshape(*self._episode.shape, -1)

    def export(self, path: str | Path, *, force: bool = False) -> None:
        """Write the greedy Controller as a program of its own, which JAX runs without this package.

        It is `jax.export`'s file of StableHLO for CPUs and NVIDIA's GPUs, of a function from observations [B, n] and
        subgoals [B, m], as of `subgoal`, to actions [B, act] in [-1, 1]; any B. Learner chronosrl gives those of
        `controller.chronosrl.action_chunk` env steps, one after another. It is read back by
        `jax.export.deserialize(bytearray(Path(path).read_bytes())).call(obs, subgoal)`.

        Raises:
          UserError: in one line, if the file cannot be written, or exists and `force` is not set.
        """
        files.check(Path(path), (EXPORTED,), force=force)
        written = _exported(self.spec, self._program.hyper, self._state)
        with files.whole(Path(path)) as partial_path:
            partial_path.write_bytes(written)

    def _begun(self, obs: Float[np.ndarray, "B n"]) -> _Episode:
        return _Episode(*_begin(self.spec, self._program.hyper, self._state, obs, self._key))

    def _check(self, episode: _Episode, obs: np.ndarray) -> None:
        """Raise `UserError` for another number of bodies, or after the end of the episode."""
        bodies = len(episode.memory.clock)
        if len(obs) != bodies:
            raise UserError(f"obs: of {len(obs)}, but the episode began with {bodies}; agent.reset() begins another")
        if episode.steps == self.spec.episode_length:
            raise UserError(f"obs: the episode of {episode.steps} env steps is over; agent.reset() begins another")


def load(run_dir: Path, *, checkpoint: str = "last", seed: int | None = None) -> TrainedAgent:
    """The agent of `seed` (None: the first) in a checkpoint of a run; raises `UserError`, as `star.load` does."""
    program, number, state, env_steps = read(run_dir, checkpoint=checkpoint, seed=seed)
    return TrainedAgent(program, state, run_dir=run_dir, env_steps=env_steps, seed=program.seeds[number])


def read(run_dir: Path, *, checkpoint: str, seed: int | None) -> tuple[Program, int, TrainState, int]:
    """The program of a run, and of the agent that `load` gives its number there, its state and its env steps."""
    program = programs.build(load_to_act(run_dir, {}))
    number = saved.agent_number(program.seeds, run_dir, seed)
    env_steps, states = saved.load_state(program, run_dir, checkpoint)
    return program, number, saved.of_one(states, number), env_steps


@partial(jax.jit, static_argnames="spec")  # agents of one kind share it
def _begin(
    spec: Spec, config: AgentConfig, state: TrainState, obs: Float[Array, "B n"], key: Array
) -> tuple[TrainState, Roadmap, Memory, Array]:
    """The state as it acts, its roadmap, the memory at the start, and the keys of all segments."""
    agent, segments = levels.of(config, spec, greedy=True), spec.episode_length // config.tutor.period
    _, keys = hierarchy.segment_keys(key, segments)
    return *hierarchy.prepare(agent, state), hierarchy.begin(agent, state, spec.abstract(obs)), keys


@partial(jax.jit, static_argnames="spec")  # agents of one kind share it
def _decide(
    spec: Spec,
    config: AgentConfig,
    state: TrainState,
    roadmap: Roadmap,
    memory: Memory,
    obs: Float[Array, "B n"],
    keys: Key[Array, "3"],
) -> tuple[Memory, Any, Array, Array, Array]:
    """The first env step of a segment: memory for the next one, who explores, subgoal, action and plan."""
    agent = levels.of(config, spec, greedy=True)
    memory, _, _, choice, explore = hierarchy.decide(
        agent, state, roadmap, memory, (), obs, spec.success(obs), env_steps=None, keys=(keys[0], keys[1], keys[2])
    )
    memory = agent.commander.tick(config.commander, memory, steps=config.tutor.period)
    seen, plan = hierarchy.observe(agent, obs, choice.subgoal), hierarchy.no_plan(agent, len(obs))
    key = hierarchy.step_keys(agent, keys[2])[0]
    action, plan = hierarchy.act(agent, state, seen, plan, number=0, explore=explore, key=key)
    return memory, explore, choice.subgoal, action, plan


@partial(jax.jit, static_argnames="spec")  # agents of one kind share it
def _go_on(
    spec: Spec,
    config: AgentConfig,
    state: TrainState,
    subgoal: Array,
    before: Array,
    obs: Array,
    plan: Array,
    number: Array,
    explore: Array,
    keys: Key[Array, "3"],
) -> tuple[Array, Array, Array]:
    """Env step `number` of a segment, not the first: subgoal, action and plan."""
    agent = levels.of(config, spec, greedy=True)
    subgoal = hierarchy.follow(agent, subgoal, before, obs)
    seen = hierarchy.observe(agent, obs, subgoal)
    key = hierarchy.step_keys(agent, keys[2])[number]
    return subgoal, *hierarchy.act(agent, state, seen, plan, number=number, explore=explore, key=key)


def _exported(spec: Spec, config: AgentConfig, state: TrainState) -> bytearray:
    """The greedy Controller as `jax.export` writes it; what it has learnt is inside."""
    agent = levels.of(config, spec, greedy=True)

    def controller(obs: Float[Array, "B n"], subgoal: Float[Array, "B m"]) -> Float[Array, "B act"]:
        seen, section = hierarchy.observe(agent, obs, subgoal), config.controller
        action = agent.controller.act(section, state.controller, seen, explore=False, key=state.key)
        return jnp.clip(action, -1.0, 1.0)

    (batch,) = export.symbolic_shape("B")
    sizes = (spec.state_dim + len(spec.goal_indices), agent.task.subgoals.size)
    shapes = [jax.ShapeDtypeStruct((batch, size), jnp.float32) for size in sizes]
    return export.export(jax.jit(controller), platforms=("cpu", "cuda"))(*shapes).serialize()


def _as_array(obs: Any, size: int) -> Float[np.ndarray, "*batch n"]:
    """`obs` as one float32 array, if that is what an agent can see; raises `UserError`."""
    if isinstance(obs, Mapping):
        for name in _DICT:
            if name not in obs:
                raise UserError(f"obs: has no {name!r}; allowed: an array, or a mapping with {' and '.join(_DICT)}")
        parts = [obs[name] for name in _DICT]
    else:
        parts = [obs]
    try:
        with np.errstate(over="ignore"):  # what float32 cannot hold is infinite, which is told below
            found = np.concatenate([np.asarray(part, np.float32) for part in parts], axis=-1)
    except (TypeError, ValueError):
        raise UserError(f"obs: is no array of numbers; allowed: shape ({size},) or (B, {size})") from None
    if found.ndim not in (1, 2) or found.shape[-1] != size or not found.size:
        raise UserError(f"obs: its shape is {found.shape}; allowed: ({size},) or (B, {size}), the state, then the goal")
    wrong = np.argwhere(~np.isfinite(found))
    if len(wrong):
        place = ", ".join(map(str, wrong[0]))
        raise UserError(f"obs: entry [{place}] is {found[tuple(wrong[0])]}; allowed: finite numbers")
    return found
