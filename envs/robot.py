"""A robot of a user's own, from its XML, as a body for `MazeEnv`.

>>> arena = envs.read_arena("room.txt", cell=4.0)
>>> env = envs.MazeEnv.of("car_room", envs.Robot("car.xml", arena), arena)

    state   qpos, then qvel, as MuJoCo has them: position (x, y) first; the angle of a hinge without a range, such as a
            wheel's, in [-pi, pi]
    action  one number in [-1, 1] for each actuator, over its `ctrlrange`
    start   the pose of the XML at the start's place, with noise

The robot is the first body of the XML. It stands on a free joint, or on two slide joints along x and y, with others
after them. The arena brings floor and walls, so the XML has none. The robot's touching geoms collide with geoms of
contype 0 and conaffinity 1, so MuJoCo's defaults do.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import scene
from envs.arena import Arena
from envs.common import reading
from envs.maze import uprightness
from envs.options import ENGINES, EnvError, known
from envs.physics import Physics, PhysicsState

ON_ITS_BACK = -0.5  # the robot is flipped when the vertical part of its own up axis is below


class Robot:
    """The body for `MazeEnv`. For another state, write a subclass with its own `state_dim` and `observe`."""

    def __init__(
        self,
        xml: str | Path,
        arena: Arena,
        *,
        engine: str = "auto",
        frames: int = 5,
        noise: float = 0.05,
    ):
        """Read the robot and put it into the arena.

        Args:
          xml: path of a MuJoCo model of the robot alone.
          arena: where it moves.
          engine: `auto` takes the fastest of `native`, `jax` and `warp` that this machine has.
          frames: time steps of the XML's `option timestep` to an env step.
          noise: standard deviation of the start's qpos (but x and y) and qvel, in their units.

        Raises:
          EnvError: in one line, if the XML cannot be used or the engine cannot run here.

        """
        self._xml, self.arena, self._noise = Path(xml), arena, noise
        if engine not in ENGINES:
            raise EnvError(f'engine is "{engine}"; {known(engine, ENGINES)}')
        model = self._model(visual=False)
        self._free = _stands_free(model, self._xml)
        if not model.nu or not model.actuator_ctrllimited.all():
            raise EnvError(f"{self._xml}: allowed: one actuator or more, each with a ctrlrange")
        self.physics = Physics(model, engine=engine, frames=frames)
        low, high = model.actuator_ctrlrange.T.astype(np.float32)
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self._start = np.array(model.qpos0, np.float32)
        turning = (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & (model.jnt_limited == 0)
        self._turning = np.isin(np.arange(model.nq), model.jnt_qposadr[turning])
        self.state_dim: int = model.nq + model.nv
        self.action_size: int = model.nu
        self.orientation: tuple[int, ...] = (3, 4, 5, 6) if self._free else ()
        self.velocity: tuple[int, ...] = (model.nq, model.nq + 1) if self._free else ()
        self.dt = self.physics.dt

    @property
    def engine(self) -> str:
        """The engine of the physics."""
        return self.physics.engine

    def init(self, rng: jax.Array, position: jax.Array) -> PhysicsState:
        """A noisy start at `position` [2]."""
        qpos_rng, qvel_rng = jax.random.split(rng)
        start = jnp.asarray(self._start)
        qpos = start + self._noise * jax.random.normal(qpos_rng, start.shape)
        qpos = qpos.at[:2].set(position)
        if self._free:
            qpos = qpos.at[2].set(start[2] + self.arena.floor_height)
            qpos = qpos.at[3:7].divide(jnp.linalg.norm(qpos[3:7]))
        return self.physics.init(qpos, self._noise * jax.random.normal(qvel_rng, (self.physics.model.nv,)))

    def step(self, data: PhysicsState, action: jax.Array) -> PhysicsState:
        """Hold the controls of `action` [action_size], in [-1, 1], for `dt` seconds."""
        return self.physics.step(data, self._middle + self._half * action)

    def observe(self, data: PhysicsState, steps: jax.Array) -> jax.Array:
        """The state [state_dim], `steps` env steps into the episode."""
        wrapped = jnp.arctan2(jnp.sin(data.qpos), jnp.cos(data.qpos))
        return jnp.concatenate([jnp.where(self._turning, wrapped, data.qpos), data.qvel])

    def displace(self, data: PhysicsState, offset: jax.Array) -> PhysicsState:
        """The robot moved by `offset` [2]; the solver corrects what gets into a wall."""
        return data.replace(qpos=data.qpos.at[:2].add(offset))

    def flipped(self, data: PhysicsState) -> jax.Array:
        """True if its own up axis points down; never without a free joint."""
        if not self._free:
            return jnp.zeros((), bool)
        return uprightness(data.qpos[3:7]) < ON_ITS_BACK

    def fallen(self, data: PhysicsState) -> jax.Array:
        """True if it is below half the height of the floor; never without a free joint."""
        if not self._free or not self.arena.floor_height:
            return jnp.zeros((), bool)
        return data.qpos[2] < self.arena.floor_height / 2

    def unhealthy(self, data: PhysicsState) -> jax.Array:
        """Never; nobody says how high it stands."""
        return jnp.zeros((), bool)

    def dropped(self, data: PhysicsState) -> jax.Array:
        """True if MJX-Warp ran out of room for contacts."""
        return data.overflow > 0

    def model(self) -> mujoco.MjModel:
        """The model with a checkered floor."""
        return self._model(visual=True)

    def pose(self, data: PhysicsState) -> tuple[jax.Array, jax.Array]:
        """(qpos, mocap_pos)."""
        return data.qpos, data.mocap_pos

    def _model(self, *, visual: bool) -> mujoco.MjModel:
        try:
            reading.check_regular(self._xml)
            return scene.build_model(self.arena, mujoco.MjSpec.from_file(str(self._xml)), {}, visual=visual)
        except OSError as error:
            raise EnvError(f"{self._xml}: cannot be read: {error.strerror}") from None
        except ValueError as error:
            raise EnvError(f"{self._xml}: {' '.join(str(error).split())}") from None


def _stands_free(model: mujoco.MjModel, xml: Path) -> bool:
    """True if the first joint is free; raises `EnvError` if neither that nor two slides along x and y come first."""
    kinds: Sequence[int] = model.jnt_type
    if len(kinds) and kinds[0] == mujoco.mjtJoint.mjJNT_FREE:
        return True
    slides = len(kinds) > 1 and all(kind == mujoco.mjtJoint.mjJNT_SLIDE for kind in kinds[:2])
    if not slides or not np.allclose(model.jnt_axis[:2], [scene.AXES["x"], scene.AXES["y"]]):
        raise EnvError(f"{xml}: its first joints are no free one and no slides along x and y; allowed: one of the two")
    return False
