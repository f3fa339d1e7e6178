"""STAR as an experiment: environments, the three levels that learn in them, and what people see of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from envs import arena, goal_env
from envs.common import modes, plugins
from envs.options import normal
from envs.vector import VectorEnv
from star import devices, learners
from star.agent import checks, environment, levels, memory, play, region_rows
from star.agent import epoch as learning
from star.agent.episodes import summarise
from star.agent.play import Episode
from star.agent.sections import AgentConfig, Config
from star.agent.state import TrainState
from star.config.loading import parse
from star.config.section import ConfigError
from star.sgim import teachers
from star.sgim.sections import TeacherConfig
from star.sgim.teachers import Demonstrations
from star.spec import Spec
from star.training.experiment import Experiment, over_seeds
from star.training.journal import mean

_EVALUATED = ("success_any", "success_final", "distance", "return", "flipped", "time_at_goal")
_SHARE = "sgim/share_"
_FAULTS = ("env/non_finite", "env/overflow")
_OF_REWARDS = ("reward", "reward_scale", "termination_penalty", "tilt_penalty", "tilt_start", "tilt_steps")


class Star(Experiment):
    """Three levels in an environment."""

    def __init__(self, config: Config) -> None:
        env, test_env = (environment.make(config, goals) for goals in ("train", "test"))
        self.spec = Spec.of(env, heading=config.tutor.heading if config.tutor.enabled else None)
        """The levels' knowledge of the environment."""
        super().__init__(resolve(config, environment.engine_of(config, env), self.spec))
        config = self.config
        try:
            checks.check(config, self.spec)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        if config.sgim.enabled:
            goal_env.need(env, "SGIM", "with_goal")
        self.env, self.test_env = env, test_env
        self._trained = VectorEnv(env, config.trainer.num_envs, auto_reset=False)
        surplus = -config.trainer.eval_episodes % config.trainer.devices  # each device plays as many
        self._tested = VectorEnv(test_env, config.trainer.eval_episodes + surplus, auto_reset=False)
        self.tested_spec = self.spec.within(test_env)
        """The same in test episodes."""
        if self.tested_spec.episode_length % config.tutor.period:
            raise ConfigError(
                f"tutor.period: {config.tutor.period} does not divide the test episode of "
                f"{self.tested_spec.episode_length}"
            )
        self.steps_per_epoch = config.trainer.num_envs * self.spec.episode_length
        self.walls = np.asarray(env.walls)
        self.goal = _a_goal(self.spec, test_env)
        """A test goal as an abstract point [d]: the one of the task, or one of several."""

    def resolve(self, config: Config) -> Config:
        """`config` with what is really used here."""
        return resolve(config, self.config.env.engine, self.spec)

    def data(self) -> tuple[Demonstrations, ...]:
        """The teachers' demonstrations."""
        config = self.config
        return tuple(_demonstrations(config, one, self.env, self.test_env, self.spec) for one in config.sgim.teachers)

    @over_seeds
    def init(self, hyper: AgentConfig, key: jax.Array) -> TrainState:
        """A fresh run."""
        return levels.init(hyper, self.spec, key=key)

    @over_seeds
    def epoch(self, hyper: AgentConfig, data: Any, state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        """An episode of every environment, and what is learnt from it."""
        return learning.epoch(hyper, self.spec, self._trained, state, teachers=data)

    @over_seeds
    def evaluate(self, hyper: AgentConfig, state: TrainState, key: jax.Array) -> Episode:
        """Greedy episodes on test goals."""
        played = play.evaluate(hyper, self.tested_spec, self._tested, state, key=key)
        return jax.tree.map(lambda x: x[: self.config.trainer.eval_episodes], devices.whole(played))

    def rows(self, evaluated: Episode) -> list[dict[str, Any]]:
        """Statistics of the episodes of each seed."""
        seeds = len(evaluated.success_any)
        found = [summarise(jax.tree.map(lambda x, i=i: x[i], evaluated)) for i in range(seeds)]
        return [{name: one[name] for name in _EVALUATED} for one in found]

    def tables(self, hyper: AgentConfig, state: TrainState, seeds: Sequence[int]) -> list[dict[str, Any]]:
        """The regions of each seed, if it has a Commander."""
        if not self.config.commander.enabled:
            return []
        return region_rows.of(hyper, state, seeds=seeds, goal=self.goal, episode_length=self.spec.episode_length)

    def figures(self, rows: Sequence[Mapping[str, Any]], tables: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """Success with the regions, how these grew, and what SGIM chose."""
        from star.agent import figures  # Matplotlib is slow to import: a run need not wait for it to begin

        found = {"summary": figures.summary_figure(regions=tables, rows=rows, walls=self.walls)}
        if tables:
            found["growth"] = figures.growth_figure(regions=tables, walls=self.walls)
        if rows and self.config.sgim.enabled:
            found["sgim"] = figures.sgim_figure(regions=tables, rows=rows, walls=self.walls)
        return found

    def notes(self) -> list[str]:
        """A user's map that marks no goal, what a learner without a reward ignores, and samples per transition."""
        said = [(name, level.settings.samples_per_transition(size)) for name, level, size in self.config.learners()]
        notes = [f"{name}: {samples:.3g} samples per new transition" for name, samples in said if samples is not None]
        control = self.config.controller
        idle = [key for key in _OF_REWARDS if key in control.model_dump(exclude_defaults=True)]
        if control.settings.futures and idle:
            notes.append(f"controller.learner {control.learner} sees no reward; without effect: {', '.join(idle)}")
        section = self.config.env
        ours = "map" in section.options and not plugins.is_plugin(section.name)
        if ours and not any(self.test_env.arena.cells(arena.GOAL)):
            x, y = self.goal[:2]
            where = f"x {x:g} m, y {y:g} m from the start, the longest walk"
            notes.append(f'env.options.map: no cell is "{arena.GOAL}"; the goal of tests is at {where}')
        return notes

    def facts(self, rows: Sequence[Mapping[str, Any]]) -> Mapping[str, str]:
        """Regions and pairs of them, SGIM's strategies, and faults of the simulator."""
        found = {}
        regions, edges = mean(rows, "abstraction/regions"), mean(rows, "refinement/edges")
        if regions is not None:
            found["regions"] = f"{regions:.0f}" + ("" if edges is None else f", {edges:.0f} pairs reach")
        shares = [key for row in rows[:1] for key in row if key.startswith(_SHARE)]
        if shares:
            named = {key.removeprefix(_SHARE): mean(rows, key) for key in shares}
            found["strategies"] = "  ".join(f"{name} {share:.2f}" for name, share in named.items())
        if wrong := sum(row.get(key, 0.0) for row in rows for key in _FAULTS):
            found["simulator faults"] = f"{wrong:.0f}"
        return found

    def placement(self, state: TrainState, mesh: Mesh | None, whole: TrainState) -> TrainState:
        """The parts that learners of levels cut in shares; all else is whole."""

        def of(axis: int) -> Any:
            return devices.everywhere(mesh) if axis == learners.WHOLE else devices.in_shares(mesh, axis=1 + axis)

        cut = {
            name: jax.tree.map(of, learners.find(level.learner).shards(getattr(state, name)))
            for name, level, _ in self.config.learners()
        }
        return whole.replace(**cut)

    def scratch(self, seeds: int) -> Mapping[str, int]:
        """Bytes of rollouts, and of what networks keep of a batch to learn from it."""
        return memory.scratch(self.config, self.spec, seeds)


def resolve(config: Config, engine: str, spec: Spec) -> Config:
    """`config` with the engine, the map, the initial cuts and the teachers' files that are really used."""
    values = config.model_dump(mode="json")
    values["env"]["engine"] = engine
    for key in ("options", "training"):
        options = values["env"][key] = normal(values["env"][key])
        if "map" in options:  # the run must not change with the file
            options["map"] = arena.load(options["map"])
    for teacher in values["sgim"]["teachers"]:
        teacher["sha256"] = teacher["sha256"] or teachers.checksum(teacher["source"])
    if values["abstraction"]["cuts"] is None and values["abstraction"]["grid"] is None:
        values["abstraction"]["cuts"] = spec.region_cuts
    return parse(values)


def _demonstrations(config: Config, teacher: TeacherConfig, env: Any, tested: Any, spec: Spec) -> Demonstrations:
    """The demonstrations of a teacher; raises `UserError` if they are wrong."""
    if teacher.source == "map":
        goal_env.need(env, "a teacher by map", "arena")
        demos = teachers.shortest_paths(env)
    else:
        demos = teachers.load(Path(teacher.source), env=config.env.name, spec=spec, sha256=teacher.sha256)
    if teacher.kind == "action" and demos.actions is None:
        raise ConfigError(f"sgim.teachers: {teacher.source} shows no actions; {teacher.name} cannot be of kind action")
    if teacher.flaw == "repetitive":
        return teachers.repetitive(demos)
    if teacher.flaw == "other_body":
        return teachers.other_body(demos)
    if teacher.flaw == "wrong_half":
        return teachers.wrong_half(demos, spec.goal_point(tested.reset(modes.key(0)).obs))
    return demos


def _a_goal(spec: Spec, env: Any) -> np.ndarray:
    """A goal that `env` draws, as an abstract point [d]; dimensions that goals leave open are 0."""

    def drawn(key: jax.Array) -> jax.Array:
        return spec.goal_point(jax.numpy.concatenate([jax.numpy.zeros(spec.state_dim), env.draw_goal(key)]))

    return np.asarray(jax.jit(drawn)(modes.key(0)))  # operation by operation it would compile twenty programs
