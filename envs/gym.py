"""The tasks as Gymnasium environments, one at a time or as a batch. `envs.registration` gives them their ids.

    observation = observation: state, achieved_goal: its entries that the goal fixes, desired_goal
    reward      = compute_reward(achieved_goal, desired_goal, info)
    info        = distance (m), is_success, fault

Both kinds run a `VectorEnv` through two compiled functions, which all environments of the same task, options and
number share: `envs.gym_program`.

Distance, success and reward are computed on the host from the observation. Computed along with the step they could
differ in the last bit from what `compute_reward` makes of the same goals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

import envs
from envs.common.plainly import plain
from envs.gym_program import Observation, Program, compute_reward, goals, like, program, raw, read, spaces
from envs.maze import MazeEnv

Info = dict[str, Any]

RENDER_MODE = "rgb_array"


class _Travels:
    """The part of an environment that goes through pickle: how it was made, and the arrays of its state."""

    _made: tuple[str, dict[str, Any], int]
    _program: Program
    _state: Any

    def __getstate__(self) -> dict[str, Any]:
        left = {"_program", "maze"}
        kept = {name: value for name, value in vars(self).items() if name not in left}
        if self._state is not None:
            kept["_state"] = [np.asarray(raw(leaf)) for leaf in jax.tree.leaves(self._state)]
        return kept

    def __setstate__(self, kept: dict[str, Any]) -> None:
        vars(self).update(kept)
        self._program = program(*self._made)
        self.maze = self._program.env
        if self._state is not None:
            blank, structure = jax.tree.flatten(self._program.blank)
            leaves = [like(one, array) for one, array in zip(blank, self._state, strict=True)]
            self._state = jax.tree.unflatten(structure, leaves)


class GymEnv(_Travels, gymnasium.Env[Observation, np.ndarray]):
    """One environment. `maze` is the `MazeEnv` that it runs.

    An episode is truncated after `episode_length` steps, and by a fault of the simulator, which sets `info["fault"]`.
    It is terminated only if an option of the task asks for that.
    """

    metadata: dict[str, Any] = {"render_modes": [RENDER_MODE], "render_fps": 10}

    def __init__(
        self,
        task: str,
        *,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str = "follow",
        **options: Any,
    ):
        """Make `task` with the options of `envs.make`; pictures are `width` by `height` pixels from `camera`.

        Raises:
          EnvError: in one line, if a name or value is wrong, or the engine cannot run here.
        """
        self._made = task, options, 1
        self._program = program(*self._made)
        self.maze = self._program.env
        self.observation_space, self.action_space = spaces(self.maze)
        self.metadata = self.metadata | {"render_fps": max(round(1 / self.maze.dt), 1)}
        self.render_mode = _checked_mode(render_mode)
        self._picture = {"width": width, "height": height, "camera": camera}
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Info]:
        """Begin an episode. The same seed gives the same start and goal, and so do those drawn from it later.

        Raises:
          ValueError: in one line, if `options` names any option: there are none.
        """
        _check_options(options)
        super().reset(seed=plain(seed))
        everyone = np.ones(1, bool)
        self._state, array = self._program.begin(self._program.blank, everyone, _bits([self.np_random]))
        record = read(self.maze, array)
        return _first(goals(self.maze, record.obs)), _first(_info(self.maze, record.obs))

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, Info]:
        """One env step; `action` [action_size] is clipped to [-1, 1]."""
        action = _checked_action(action, self.action_space)[None]
        self._state, array = self._program.step(_started(self._state), action)
        record = read(self.maze, array)
        observation = goals(self.maze, record.obs)
        reward = compute_reward(self.maze, observation["achieved_goal"], observation["desired_goal"])
        (truncated,), (done,) = record.truncated.tolist(), record.done.tolist()
        info = _first(_info(self.maze, record.obs, record.fault))
        return _first(observation), reward.item(), done and not truncated, truncated, info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """The reward [...] for goals [..., k], to the bit that of a step that ends in them. `info` is not used."""
        return compute_reward(self.maze, achieved_goal, desired_goal)

    def render(self) -> Any:
        """A picture, uint8 [height, width, 3], with `render_mode="rgb_array"`; else nothing."""
        if self.render_mode is None:
            return _nothing_to_render()
        return _picture(self.maze, _started(self._state), 0, self._picture)


class GymVectorEnv(_Travels, gymnasium.vector.VectorEnv[Observation, np.ndarray, np.ndarray]):
    """`num_envs` (B) environments in one batch. One that ends begins its next episode within the same step.

    Observation and info are then those of the new episode, `infos["final_obs"]` and `infos["final_info"]` those of
    the step that ended the last one.
    """

    metadata: dict[str, Any] = GymEnv.metadata | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str = "follow",
        **options: Any,
    ):
        """Make a batch of `task`; all else as for `GymEnv`."""
        num_envs = plain(num_envs)
        if type(num_envs) is not int or num_envs < 1:
            raise envs.EnvError(f"num_envs is {num_envs!r}; allowed: a whole number above 0")
        self._made = task, options, num_envs
        self._program = program(*self._made)
        self.maze = self._program.env
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = spaces(self.maze)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.metadata = self.metadata | {"render_fps": max(round(1 / self.maze.dt), 1)}
        self.render_mode = _checked_mode(render_mode)
        self._picture = {"width": width, "height": height, "camera": camera}
        self._state: Any = None
        self._generators: list[np.random.Generator] | None = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin all episodes, or those of `options["reset_mask"]` (bool [B]) alone.

        One seed is of the whole batch. Of a list [B] each environment has its own: its episodes start as those of a
        `GymEnv` with that seed. None in it leaves an environment's stream as it is.

        Raises:
          ValueError: in one line, if the mask or the number of seeds is wrong, or `options` names another option.
        """
        _check_options(options, "reset_mask")
        seed = plain(seed)
        if isinstance(seed, list):
            self._generators = _seeded(seed, self._generators, self.num_envs)
        else:
            super().reset(seed=seed)  # type: ignore[arg-type]  # `plain` tells nothing of types
            self._generators = None if seed is not None else self._generators
        mask = (options or {}).get("reset_mask")
        if mask is None:
            before, mask = self._program.blank, np.ones(self.num_envs, bool)
        else:
            before, mask = _started(self._state), _checked_mask(mask, self.num_envs)
        obs = self._begin(before, mask)
        return goals(self.maze, obs), _masked(_info(self.maze, obs), mask)

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, Info]:
        """One env step of every environment; `actions` [B, action_size] are clipped to [-1, 1]."""
        actions = _checked_action(actions, self.action_space)
        self._state, array = self._program.step(_started(self._state), actions)
        record, everyone = read(self.maze, array), np.ones(self.num_envs, bool)
        reached, done = goals(self.maze, record.obs), record.done
        rewards = compute_reward(self.maze, reached["achieved_goal"], reached["desired_goal"]).astype(np.float64)
        flags = (done & ~record.truncated, record.truncated)
        infos = _info(self.maze, record.obs, record.fault)
        if not done.any():
            return reached, rewards, *flags, _masked(infos, everyone)
        final: Info = {"final_obs": _each(reached, done), "_final_obs": done.copy()}
        final |= {"final_info": _masked(infos, done), "_final_info": done.copy()}
        obs = self._begin(self._state, done)
        infos = _masked(_info(self.maze, obs, record.fault & ~done), everyone)
        return goals(self.maze, obs), rewards, *flags, infos | final

    def _begin(self, state: Any, mask: np.ndarray) -> np.ndarray:
        """Begin new episodes where the mask says so; returns all observations [B, n]."""
        self._state, array = self._program.begin(state, mask, self._drawn(mask))
        return read(self.maze, array).obs

    def _drawn(self, mask: np.ndarray) -> np.ndarray:
        """Random bits for the environments of the mask: a generator that they do not share draws for them alone."""
        if self._generators is None:
            return _bits([self.np_random])
        bits = np.zeros((self.num_envs, 2), np.uint32)
        bits[mask] = _bits([one for one, begins in zip(self._generators, mask, strict=True) if begins])
        return bits

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """The reward [...] for goals [..., k], to the bit that of a step that ends in them. `info` is not used."""
        return compute_reward(self.maze, achieved_goal, desired_goal)

    def render(self) -> Any:
        """A picture of each environment, uint8 [height, width, 3], with `render_mode="rgb_array"`; else nothing."""
        if self.render_mode is None:
            return _nothing_to_render()
        state = _started(self._state)
        return tuple(_picture(self.maze, state, i, self._picture) for i in range(self.num_envs))


def _info(env: MazeEnv, obs: np.ndarray, fault: np.ndarray | None = None) -> Info:
    """Info of a batch, each value [B]; no fault unless given."""
    offset = obs[:, list(env.goal_indices)] - obs[:, env.state_dim :]
    distance = np.sqrt(np.square(offset).sum(axis=-1))
    return {
        "distance": distance.astype(np.float64),
        "is_success": distance < env.success_radius,
        "fault": np.zeros(len(obs), bool) if fault is None else fault,
    }


def _first(batch: dict[str, Any]) -> dict[str, Any]:
    """The first of a batch; numbers become Python's."""
    return {key: value[0] if value.ndim > 1 else value[0].item() for key, value in batch.items()}


def _each(batch: Observation, mask: np.ndarray) -> np.ndarray:
    """An array [B] of one dictionary for each environment of the mask, None for the others."""
    found = np.full(len(mask), None, object)
    for i in np.flatnonzero(mask):
        found[i] = {key: value[i].copy() for key, value in batch.items()}
    return found


def _masked(info: Info, mask: np.ndarray) -> Info:
    """Info as Gymnasium's vector environments give it: 0 outside of the mask, and the mask under `_key`."""
    values = {key: np.where(mask, value, np.zeros_like(value)) for key, value in info.items()}
    return values | {f"_{key}": mask.copy() for key in info}


def _seeded(seeds: list[Any], old: list[np.random.Generator] | None, num_envs: int) -> list[np.random.Generator]:
    """A generator for each seed; where that is None the old one, if there is any."""
    if len(seeds) != num_envs:
        raise ValueError(f"seed is a list of {len(seeds)}; allowed: a whole number, or a list of {num_envs}")
    if old is None:
        old = [seeding.np_random()[0] for _ in seeds]
    return [one if seed is None else seeding.np_random(seed)[0] for seed, one in zip(seeds, old, strict=True)]


def _checked_action(action: Any, space: gymnasium.Space[Any]) -> np.ndarray:
    action = np.asarray(action, np.float32)
    if action.shape != space.shape:
        raise ValueError(f"the shape of an action is {action.shape}; allowed: {space.shape}")
    return action


def _check_options(options: dict[str, Any] | None, *known: str) -> None:
    for key in options or {}:
        if key not in known:
            raise ValueError(f"reset has no option {key!r}; allowed: {', '.join(known) or 'none'}")


def _checked_mask(mask: Any, num_envs: int) -> np.ndarray:
    if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (num_envs,) or not mask.any():
        raise ValueError(f"reset_mask is {mask!r}; allowed: a NumPy array of {num_envs} bool, one of them true")
    return mask


def _checked_mode(mode: str | None) -> str | None:
    if mode not in (None, RENDER_MODE):
        raise envs.EnvError(f'render_mode is {mode!r}; allowed: None, "{RENDER_MODE}"')
    return mode


def _nothing_to_render() -> None:
    gymnasium.logger.warn(f'nothing is rendered: make the environment with render_mode="{RENDER_MODE}"')


def _picture(env: MazeEnv, state: Any, i: int, picture: dict[str, Any]) -> np.ndarray:
    from envs import render

    goal = np.asarray(state.obs[i, env.state_dim :])
    data = jax.tree.map(lambda leaf: leaf[i], state.pipeline_state.data)
    return render.frame(env, data, marks=render.Marks(goal=goal), **picture)


def _bits(generators: Sequence[np.random.Generator]) -> np.ndarray:
    """64 random bits of each generator: uint32 [n, 2]."""
    return np.stack([generator.integers(2**32, size=2, dtype=np.uint32) for generator in generators])


def _started(state: Any) -> Any:
    if state is None:
        raise ResetNeeded("the environment has not been reset")
    return state
