"""CHIME as an experiment: robots in rooms, side by side, and what people see of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from envs.worlds import room as rooms
from envs.worlds.room import Errand, Room, RoomState
from star.saht.chime import loop, planner
from star.saht.chime.candidates import NOBODY
from star.saht.chime.loop import State
from star.saht.chime.models import ACTION
from star.saht.chime.planner import Aim
from star.saht.chime.sections import Config, Learner
from star.training.experiment import Experiment, numbers, over_seeds
from star.training.journal import mean

ACTIONS = 30
"""Of a test."""
REACHED = 20.0
"""A test is a success if the disc ends so near to the goal, in units of the room: its radius; half of it for a push."""


class Chime(Experiment):
    """Robots that find out what they can control."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.room = Room(config.room.movable, config.room.fixed, config.room.wall)
        self.steps_per_epoch = config.chime.epoch
        self.errands = rooms.errands(self.room)

    @over_seeds
    def init(self, hyper: Learner, key: Array) -> State:
        """A fresh learner."""
        return loop.init(hyper.chime, self.room, key=key)

    @over_seeds
    def epoch(self, hyper: Learner, data: Any, state: State) -> tuple[State, dict[str, Array]]:
        """Some episodes, and an evolution of the models."""
        state, seen = loop.epoch(hyper.chime, self.room, state)
        return state, self._metrics(hyper, state, seen)

    def _metrics(self, hyper: Learner, state: State, seen: loop.Seen) -> dict[str, Array]:
        slots, population = hyper.chime.models, state.population
        outcome, _, context, _ = jax.tree.map(lambda leaf: leaf[:slots], population.models)
        on, competence = population.enabled[:slots], population.competence[:slots]
        found, spent = {"chime/models": on.sum()}, seen.spent.sum(axis=1)
        for number, name in enumerate(self.room.discs):
            mine = on & (outcome == number)
            best = planner.best_slot(population, jnp.asarray(number), slots)
            births = state.births[number]
            first = jnp.where(births == NOBODY, jnp.iinfo(births.dtype).max, births).min()
            found |= {
                f"chime/competence_{name}": jnp.where(mine, competence, 0.0).max(),
                f"chime/born_{name}": jnp.where((births == NOBODY).all(), NOBODY, first),
                f"chime/inputs_{name}": jnp.where(mine.any(), context[best].sum(), 0),
                f"chime/practice_{name}": (spent * (outcome == number)).sum() / hyper.chime.blocks,
                f"chime/moved_{name}": seen.moved[number],
            }
        return found

    @over_seeds
    def evaluate(self, hyper: Learner, state: State, key: Array) -> dict[str, Array]:
        """The tests: where a disc ends that shall be brought to a place."""
        goals = jnp.array([errand.goal for errand in self.errands])
        discs = jnp.array([errand.disc for errand in self.errands])
        path = tested(hyper, self.room, self.errands, state, key=key)
        ends = path[jnp.arange(len(discs)), -1, discs]
        off = jnp.sqrt(jnp.square(ends - goals).sum(axis=-1))
        found = {"distance": off.mean()}
        for kind in rooms.KINDS:
            mine = np.array([errand.kind == kind for errand in self.errands])
            if mine.any():
                near = REACHED / 2 if kind == "push" else REACHED
                found |= {f"distance_{kind}": off[mine].mean(), f"success_{kind}": (off[mine] < near).mean()}
        return found

    def rows(self, evaluated: Mapping[str, Any]) -> list[dict[str, Any]]:
        """The same as numbers."""
        return numbers(evaluated)

    def tables(self, hyper: Learner, state: State, seeds: Sequence[int]) -> list[dict[str, Any]]:
        """The models of each seed, and first births."""
        room = self.room
        population, births = jax.device_get((state.population, state.births))

        def label(control: int) -> str:
            return "action" if control in (ACTION, len(room.names)) else room.names[control]

        found = []
        for i in range(len(seeds)):
            one = jax.tree.map(lambda leaf, i=i: leaf[i], population)
            slots = np.flatnonzero(one.active[: hyper.chime.models])
            listed = [
                {
                    "outcome": room.names[one.models.outcome[k]],
                    "control": label(one.models.control[k]),
                    "inputs": [room.contexts[j] for j in np.flatnonzero(one.models.context[k])],
                    "competence": round(float(one.competence[k]), 4),
                    "born": int(one.born[k]),
                    "on": bool(one.enabled[k]),
                }
                for k in slots
            ]
            pairs = [[room.names[o], label(c), int(births[i, o, c])] for o, c in np.argwhere(births[i] != NOBODY)]
            found.append({"models": listed, "births": sorted(pairs, key=lambda pair: pair[2])})
        return found

    def figures(self, rows: Sequence[Mapping[str, Any]], tables: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """Tests, births, competence, practice, and the graph of models."""
        from star.saht.chime import figures  # Matplotlib is slow to import: a run need not wait for it to begin

        return dict(super().figures(rows, tables)) | figures.figures(self.room, rows, tables)

    def facts(self, rows: Sequence[Mapping[str, Any]]) -> Mapping[str, str]:
        """Models, and the competence of each disc's."""
        shares = {name: mean(rows, f"chime/competence_{name}") or 0.0 for name in self.room.discs}
        return {
            "models": f"{mean(rows, 'chime/models') or 0.0:.1f}",
            "competence": "  ".join(f"{name} {share:.2f}" for name, share in shares.items()),
        }


def tested(
    hyper: Learner, room: Room, errands: Sequence[Errand], state: State, *, key: Array
) -> Float[Array, "n T D 2"]:
    """The places of all discs in tests, before each action and after the last one.

    The learner plans with its best model of the disc; without one it acts at random.
    """
    slots = hyper.chime.models

    def one(errand: Any, key: Array) -> Array:
        places, disc, goal = errand
        world = RoomState(places, jnp.zeros((len(room.discs) - 1, 2)))
        slot = planner.best_slot(state.population, disc, slots)
        able = state.population.enabled[slot] & (state.population.models.outcome[slot] == disc)
        world, _, values = loop.act(hyper.chime, room, state, world, Aim(slot, goal), able, actions=ACTIONS, key=key)
        return jnp.concatenate([values[:, : len(room.discs)], world.places[None]])

    columns = [jnp.array([getattr(errand, name) for errand in errands]) for name in ("places", "disc", "goal")]
    return jax.vmap(one)(columns, jax.random.split(key, len(errands)))
