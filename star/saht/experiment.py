"""SGIM-SAHT as an experiment: a world, learners side by side that practise in it, and what people see of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from envs import worlds
from envs.common.errors import UserError, where_raised
from star.config.section import ConfigError
from star.saht import choose, evaluation, loop, memory, teachers
from star.saht.loop import SPLIT_EVERY, Seen, State
from star.saht.proposals import Setting, Way
from star.saht.sections import Config, Learner
from star.saht.teachers import Shown
from star.sgim import selection
from star.sgim.sections import SelectionConfig
from star.sgim.selection import SgimState
from star.training.experiment import Experiment, numbers, over_seeds
from star.training.journal import mean

EPOCHS = 2**31 - 1  # the stream of keys of epochs, apart from those of blocks


class Saht(Experiment):
    """Learners of skills in a world."""

    def __init__(self, config: Config) -> None:
        try:
            self.world = worlds.make(config.world.name, noise=config.world.noise, **config.world.options)
        except UserError as error:
            raise ConfigError(f"world: {error}") from None
        super().__init__(self.resolve(config))
        section = self.config.saht
        self._check(self.config)
        self.scale = memory.scale_of(self.world)
        self.steps_per_epoch = section.epoch
        self.ways = ways(self.config, self.world)
        self.goals = goals(self.world)
        """Those of the evaluation, of each task: made here, as a world may need a program of its own for them."""

    def resolve(self, config: Config) -> Config:
        """`config` with every teacher by himself, and as much memory as the run needs."""
        section = config.saht
        rows = section.memory or _iterations(config)
        found = {"teachers": teachers.expanded(section.teachers, self.world), "memory": rows}
        return config.model_copy(update={"saht": section.model_copy(update=found)})

    def _check(self, config: Config) -> None:
        section, longest = config.saht, self.world.longest
        if longest < 2 and ("procedures" in section.strategies or "procedure" in {t.kind for t in section.teachers}):
            raise ConfigError(
                f"saht: procedures need sequences of two primitives; those of {self.world.name} have {longest}"
            )
        unable = [task.name for task in self.world.tasks if task.demonstrate is None]
        for name in {"dagger", "cba"} & set(section.strategies):
            if unable:
                raise ConfigError(
                    f"saht.strategies: {name} needs a teacher of every task; nobody demonstrates {unable[0]} in "
                    f"{self.world.name}"
                )
        if _iterations(config) > (section.memory or 0):
            raise ConfigError(
                f"trainer.total_env_steps: {config.trainer.total_env_steps}, in whole epochs of {section.epoch}, is "
                f"more than saht.memory {section.memory}, the sequences that the run can remember"
            )

    def data(self) -> Shown:
        """The teachers' demonstrations."""
        return teachers.shown_by(self.config.saht.teachers, self.world, self.scale)

    def setting(self, shown: Shown) -> Setting:
        """The needs of strategies besides a memory."""
        return Setting(self.world, self.scale, self.ways, shown, self.config.saht.generation)

    @over_seeds
    def init(self, hyper: Learner, key: Array) -> State:
        """A fresh learner."""
        section = hyper.saht
        return loop.init(section.choice, self.world, len(self.ways), section.memory or 0, key=key)

    def epoch(self, hyper: Learner, data: Shown, state: State) -> tuple[State, dict[str, Array]]:
        """Blocks of all learners in step: the number of a block is the same for all, and no axis of seeds has it."""
        section = self.config.saht
        blocks = section.epoch // section.block
        state, there = self._begun(hyper, state)

        def step(state: State, number: Array) -> tuple[State, Seen]:
            state, seen = self._block(hyper, (data, number), state, there)
            due, split = (number + 1) % SPLIT_EVERY == 0, partial(self._split, hyper)
            return state.replace(tables=jax.lax.cond(due, split, lambda tables: tables, state.tables)), seen

        state, seen = jax.lax.scan(step, state, state.epoch[0] * blocks + jnp.arange(blocks))
        metrics = self._metrics(hyper, state, jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), seen))
        return state.replace(epoch=state.epoch + 1), metrics

    @over_seeds
    def _begun(self, hyper: Learner, state: State) -> tuple[State, Array]:
        """A learner as an epoch begins, and which strategies there are in it."""
        teachers = self.config.saht.teachers
        alone = len(self.ways) - len(teachers)
        prices = [1.0] * alone + [hyper.saht.cost if one.cost is None else one.cost for one in teachers]
        chances = jnp.array([1.0] * alone + [one.availability for one in teachers])
        key = jax.random.fold_in(jax.random.fold_in(state.key, EPOCHS), state.epoch)
        there = jax.random.uniform(key, chances.shape) < chances
        choice = state.tables.choice.replace(costs=jnp.stack([jnp.asarray(price, jnp.float32) for price in prices]))
        return state.replace(tables=state.tables.replace(choice=choice)), there

    @over_seeds
    def _block(self, hyper: Learner, data: tuple[Shown, Array], state: State, there: Array) -> tuple[State, Seen]:
        shown, number = data
        available = self._available(there, state.tallies.chosen.sum(axis=0), number)
        return loop.block(hyper.saht, self.setting(shown), state, available, number=number)

    def _available(self, there: Bool[Array, "M"], queries: Array, number: Array) -> Bool[Array, "M"]:
        """The strategies that may be chosen in the block of that number."""
        section = self.config.saht
        limits = [one.max_queries or 2**30 for one in section.teachers]
        taught = jnp.arange(len(self.ways)) >= len(section.strategies)
        there &= queries < jnp.array([2**30] * len(section.strategies) + limits)
        if section.ask_every is None:
            return there
        turn = (number % section.ask_every == section.ask_every - 1) & (there & taught).any()
        return there & (taught == turn)

    @over_seeds
    def _split(self, hyper: Learner, tables: choose.Tables) -> choose.Tables:
        return choose.split(hyper.saht.choice, tables)

    @over_seeds
    def _metrics(self, hyper: Learner, state: State, seen: Seen) -> dict[str, Array]:
        """The metrics of an epoch, whose blocks [B, ...] are `seen`."""
        task = jax.nn.one_hot(seen.choice.task, len(self.world.tasks))
        way = jax.nn.one_hot(seen.choice.strategy, len(self.ways))
        lengths = task.T @ seen.length / jnp.maximum(task.sum(axis=0), 1.0)
        grown = way.T @ seen.grown / jnp.maximum(way.sum(axis=0), 1.0)
        of_tasks = {"task": task.mean(axis=0), "length": lengths, "reached": seen.reached.sum(axis=0)}
        of_ways = {"strategy": way.mean(axis=0), "increment": grown}
        named = [(of_tasks, self.world.names), (of_ways, [one.name for one in self.ways])]
        found = {
            f"saht/{key}_{name}": values[i]
            for table, names in named
            for key, values in table.items()
            for i, name in enumerate(names)
        }
        return found | {"saht/refused": seen.refused.sum(), "saht/asked": seen.asked.sum()}

    def evaluate(self, hyper: Learner, state: State, keys: Array) -> dict[str, Array]:
        """Errors on the goals of the evaluation."""
        rows = state.epoch[0] * self.steps_per_epoch
        errors = partial(evaluation.errors, self.world, self.scale, self.goals)
        return jax.vmap(lambda known, key: errors(known, rows, key=key))(state.memory, keys)

    def rows(self, evaluated: Mapping[str, Any]) -> list[dict[str, Any]]:
        """The errors of each seed."""
        return numbers(evaluated)

    def tables(self, hyper: Learner, state: State, seeds: Sequence[int]) -> list[dict[str, Any]]:
        """Regions of goals with their interest, and all that is counted."""
        described = _described(hyper.saht.choice.selection, state.tables.goals)
        (active, regions), tallies = jax.device_get((described, vars(state.tallies)))
        found = []
        for i in range(len(seeds)):
            boxes = {name: regions[name][i, active[i]].tolist() for name in ("lower", "upper", "interest")}
            found.append(boxes | {name: leaf[i].tolist() for name, leaf in tallies.items()})
        return found

    def figures(self, rows: Sequence[Mapping[str, Any]], tables: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """Errors, and what was practised, how, when and what for."""
        from star.saht import figures  # Matplotlib is slow to import: a run need not wait for it to begin

        return figures.figures(self.world, self.ways, rows, tables)

    def facts(self, rows: Sequence[Mapping[str, Any]]) -> Mapping[str, str]:
        """The most practised task, and the share of teachers."""
        tasks = {name: mean(rows, f"saht/task_{name}") or 0.0 for name in self.world.names}
        found = {"practises": "  ".join(f"{name} {share:.2f}" for name, share in tasks.items())}
        taught = self.ways[len(self.config.saht.strategies) :]
        if taught:
            asked = sum(mean(rows, f"saht/strategy_{one.name}") or 0.0 for one in taught)
            found["asks"] = f"a teacher in {asked:.2f} of the blocks"
        return found


@jax.jit
def _described(section: SelectionConfig, goals: SgimState) -> tuple[Bool[Array, "seeds R"], dict[str, Array]]:
    """The regions of goals in use, and their bounds and interest, of all seeds."""

    def one(goals: SgimState) -> tuple[Array, dict[str, Array]]:
        where = goals.abstraction
        worth = selection.interest(section, goals)[:, 0]
        return where.active, {"lower": where.lower, "upper": where.upper, "interest": worth}

    return jax.vmap(one)(goals)


def ways(config: Config, world: worlds.World) -> tuple[Way, ...]:
    """The strategies in the order of their numbers: those alone, then the teachers."""
    alone = [Way(name, name) for name in config.saht.strategies]
    asked = [
        Way(one.name or "", one.kind, world.index(one.task or 0), number, one.source != "world")
        for number, one in enumerate(config.saht.teachers)
    ]
    return (*alone, *asked)


def _iterations(config: Config) -> int:
    """Those of a whole run: the last epoch is finished."""
    return -(-config.trainer.total_env_steps // config.saht.epoch) * config.saht.epoch


def goals(world: worlds.World) -> list[np.ndarray]:
    """The goals of the evaluation of each task [n, 4]; raises `UserError` if they cannot be made, or are none."""
    found = []
    for number, name in enumerate(world.names):
        try:
            found.append(np.asarray(world.benchmark(number)))
        except Exception as error:  # whatever the author of the world has done
            raise ConfigError(f"world: {world.name}: goals of {name} raise {where_raised(error)}") from error
        if found[-1].shape[1:] != (4,) or not len(found[-1]) or not np.isfinite(found[-1]).all():
            raise ConfigError(f"world: {world.name}: goals of {name} are no finite numbers [n, {world.dims[number]}]")
    return found
