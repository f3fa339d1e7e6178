"""The ant: 8 motors, and the 30 numbers that the paper's agents observe.

    state = qpos[0:15], qvel[0:14], t * .001      t in env steps
    start = qpos0 + U(-.1, .1), N(0, .1^2)        qpos0 has the torso .75 above the floor and every joint at 0
                                                  of JaxGCRL's models .55, ankles bent by 1 rad, x and y without noise
                                                  (.1 unless the task has another noise); of `jaxgcrl_spring` raised
                                                  until no foot is in the floor

qpos is x, y, z in m, a unit quaternion (w, x, y, z), then hip and ankle of legs 1 to 4 in rad; qvel is the velocity
of the torso in m/s (world frame), its angular velocity in rad/s (body frame), then the 8 joint velocities. Actions
follow the order of the joints, 1 standing for 30 N m.

With `untimed` the last number, the clock, is left out. Other parts of the task are hidden from this state.
The full one appends, for each block, how far it has slid along each of its axes and how fast, then 1 for each gate
that is open.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import scene
from envs.arena import BLOCK, HEIGHT
from envs.maze import uprightness, yaw
from envs.options import JAXGCRL
from envs.physics import Physics, PhysicsState
from envs.tasks import Switch, Task

MAX_TORQUE = 30.0  # N m
STEP_SCALE = 0.001  # of the step count in the state
ORIENTATION = (3, 4, 5, 6)  # indices of the quaternion in qpos and in the state
VELOCITY = (15, 16)  # those in the state of the torso's velocity along x and y
QPOS, QVEL = 15, 14  # the ant's own positions and velocities; those of blocks follow
HEALTHY = (0.2, 1.0)  # height of the torso above the floor, m
BENT = (0.55, (0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0))  # JaxGCRL's start: that height (m), and the joints (rad)
LEGS = ((1, 1), (-1, 1), (-1, -1), (1, -1))  # which way along x and y each points
FOOT = 0.08  # radius of JaxGCRL's feet, m
MUJOCO_SOLIMP = (0.9, 0.95, 0.001, 0.5, 2.0)
SPRING_SOLIMP = (0.01, 0.01, 0.001, 0.5, 2.0)  # limits that yield; see _as_in_spring
SPRING_DAMPING = 10.0  # N m s/rad
SPRING_STIFFNESS = 1000.0  # N m/rad
ON_ITS_BACK = -0.5  # the ant is flipped when the vertical part of its own up axis is below
LIFT = 2 * HEIGHT  # how far an open gate is lifted, m

INTEGRATORS = {
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
}
SOLVERS = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}
CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}


def spec(*, action_scale: float = 1.0, collisions: str = "all", model: str = "published") -> mujoco.MjSpec:
    """The ant's own model, without floor or walls. With `collisions="feet"` only torso and shins touch anything.

    `model="jaxgcrl"` has feet, which touch the floor, walls, torso and each other; torso and hips touch walls and feet
    alone. Contacts have MuJoCo's own parameters, and joints are not damped implicitly. `model="jaxgcrl_spring"` is the
    same with the masses and hinges of Brax's engine `spring`. `model="gymnasium"` has MuJoCo's parameters of contacts,
    and all else as published.
    """
    xml = resources.files("envs").joinpath("assets", "ant.xml").read_text(encoding="utf-8")
    ant = mujoco.MjSpec.from_string(xml)
    for motor in ant.actuators:
        motor.ctrlrange = action_scale * np.asarray(motor.ctrlrange)
    for geom in ant.geoms:
        if collisions == "feet" and not geom.name.startswith(("torso", "shin")):
            geom.contype = 0
    if model != "published":
        for geom in (ant.default.geom, *ant.geoms):  # the default is that of floor and walls
            geom.solimp = MUJOCO_SOLIMP
    if model in JAXGCRL:
        _as_in_jaxgcrl(ant)
    if model == "jaxgcrl_spring":
        _as_in_spring(ant)
    return ant


def _as_in_jaxgcrl(ant: mujoco.MjSpec) -> None:
    """Turn the ant into that of JaxGCRL, but for the order of its motors."""
    ant.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    for geom in ant.geoms:
        touching = geom.name.startswith(("torso", "hip"))
        geom.contype, geom.conaffinity = (scene.TORSO, 1) if touching else (0, 0)
    for leg, (x, y) in enumerate(LEGS, start=1):
        ant.body(f"shin_{leg}").add_geom(
            name=f"foot_{leg}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=[0.4 * x, 0.4 * y, 0.0],
            size=[FOOT, 0.0, 0.0],
            mass=0.0,
            contype=1,
            conaffinity=1,
        )


def _as_in_spring(ant: mujoco.MjSpec) -> None:
    """Give links and hinges what Brax's engine `spring` makes of JaxGCRL's model.

    Each link has 1 kg, and 1 kg m^2 about every axis: `spring` raises masses and inertias to the power of 1 minus a
    scale, and the model has 1 for both. Hinges have no armature, the model's `constraint_ang_damping`, and limits that
    are springs of its `constraint_limit_stiffness`. With an impedance near 0 MuJoCo's limit is a spring, too, whose
    `solref_limit` is minus the acceleration for each rad.
    """
    light = ant.copy().compile()
    ant.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    for body in ant.bodies[1:]:
        body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
        body.ipos, body.iquat = light.body(body.name).ipos, [1.0, 0.0, 0.0, 0.0]
    hinges = ant.joints[1:]
    for hinge in hinges:
        hinge.armature, hinge.damping = 0.0, np.array([[SPRING_DAMPING], [0.0], [0.0]])
    heavy = ant.copy().compile()
    for hinge in hinges:
        ease = heavy.dof_invweight0[heavy.joint(hinge.name).dofadr[0]]  # rad/s^2 for each N m
        hinge.solref_limit = [-SPRING_STIFFNESS * ease, 0.0]
        hinge.solimp_limit = SPRING_SOLIMP


def soles(qpos: jax.Array) -> jax.Array:
    """The height [4] of the lowest point of each of JaxGCRL's feet, m, of the ant at `qpos` [15]."""
    hip, ankle = qpos[7:QPOS:2], qpos[8:QPOS:2]
    sides = jnp.asarray(LEGS)
    root = 0.2 * sides  # of each thigh; a thigh is as long as its way from the torso's middle, a shin twice
    sine, cosine = jnp.sin(hip)[:, None], jnp.cos(hip)[:, None]
    thigh = cosine * root + sine * root[:, ::-1] * jnp.array([-1.0, 1.0])
    below = 0.4 * jnp.sqrt(2.0) * jnp.sin(ankle) * sides[:, 0]
    foot = jnp.concatenate([root + thigh * (1.0 + 2.0 * jnp.cos(ankle))[:, None], -below[:, None]], axis=1)
    w, x, y, z = qpos[3:7]
    up = jnp.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), uprightness(qpos[3:7])])
    return qpos[2] + foot @ up - FOOT


def build(task: Task, engine: str, options: Mapping[str, Any]) -> Ant:
    """The ant in the arena of `task`; raises `EnvError` if the engine cannot run here."""
    solver = {
        "timestep": options["timestep"],
        "integrator": INTEGRATORS[options["integrator"]],
        "solver": SOLVERS[options["solver"]],
        "cone": CONES[options["cone"]],
        "iterations": options["iterations"],
        "ls_iterations": options["ls_iterations"],
    }
    own = {key: options[key] for key in ("action_scale", "collisions", "model")}
    margins = {key: options[key] for key in ("margin", "wall_margin")}
    model = scene.build_model(task.arena, spec(**own), solver, **margins)
    physics = Physics(model, engine=engine, frames=options["frames"])
    return Ant(physics, task, **own, observed=options["observe"])


class Ant:
    """The body for `MazeEnv`: state of 30, of 29 if `observed` is `untimed`, of more if it is `full`; 8 actions."""

    def __init__(
        self,
        physics: Physics,
        task: Task,
        *,
        action_scale: float = 1.0,
        collisions: str = "all",
        model: str = "published",
        observed: str = "published",
    ):
        """Live in the model of `physics`, whose first 15 qpos, 14 qvel and 8 controls are the ant's."""
        self.physics = physics
        self.action_size = physics.model.nu
        self.orientation: tuple[int, ...] = ORIENTATION
        self.velocity: tuple[int, ...] = VELOCITY
        self.dt = physics.dt
        self._arena = task.arena
        self._switch: Switch | None = task.switch
        self._block_noise = task.block_noise
        self._spec = partial(spec, collisions=collisions, model=model)
        self._observed = observed
        self._max_torque = MAX_TORQUE * action_scale
        self._closed = np.asarray(physics.mocap_pos)
        self._blocks = len(task.arena.centres(BLOCK))
        start = np.array(physics.model.qpos0)
        self._shake = np.full(QPOS, task.pose_noise, np.float32)
        self._shake[:2] = task.place_noise
        self._start_speed = task.pose_noise
        if model in JAXGCRL:
            start[2], start[7:QPOS] = BENT
            self._shake[:2] = 0.0
        self._raised = model == "jaxgcrl_spring"  # MuJoCo would throw it up, which `spring` does not
        start[2] += task.arena.floor_height
        self._start = start.astype(np.float32)
        slides = 2 * (len(start) - QPOS)
        self.state_dim = QPOS + QVEL + (observed != "untimed") + (slides + len(self._closed)) * (observed == "full")

    @property
    def engine(self) -> str:
        """The engine of the physics."""
        return self.physics.engine

    def init(self, rng: jax.Array, position: jax.Array) -> PhysicsState:
        """A noisy start at `position` [2]."""
        qpos_rng, qvel_rng, block_rng = jax.random.split(rng, 3)
        noise = self._shake * jax.random.uniform(qpos_rng, (QPOS,), minval=-1.0, maxval=1.0)
        qpos = jnp.asarray(self._start).at[:QPOS].add(noise).at[:2].add(position)
        qpos = qpos.at[3:7].divide(jnp.linalg.norm(qpos[3:7]))
        if self._raised:
            qpos = qpos.at[2].add(jnp.maximum(self._arena.floor_height - soles(qpos[:QPOS]).min(), 0.0))
        if self._block_noise:
            first_x = QPOS + len(self._arena.block) * np.arange(self._blocks)
            qpos = qpos.at[first_x].add(self._block_noise * jax.random.normal(block_rng, first_x.shape))
        qvel = jnp.zeros(self.physics.model.nv).at[:QVEL].set(self._start_speed * jax.random.normal(qvel_rng, (QVEL,)))
        return self.physics.init(qpos, qvel)

    def step(self, data: PhysicsState, action: jax.Array) -> PhysicsState:
        """Hold the torques of `action` [8], in [-1, 1], for `dt` seconds, then lift the gate if it is time."""
        data = self.physics.step(data, self._max_torque * action)
        if self._switch is None:
            return data
        place = jnp.where(self._is_open(data) | self._at_switch(data), LIFT, 0.0)
        return data.replace(mocap_pos=jnp.asarray(self._closed).at[:, 2].add(place))

    def observe(self, data: PhysicsState, steps: jax.Array) -> jax.Array:
        """The state [state_dim]."""
        clock = STEP_SCALE * steps.astype(jnp.float32)
        moving = [data.qpos[:QPOS], data.qvel[:QVEL]]
        hidden = [data.qpos[QPOS:], data.qvel[QVEL:], self._is_open(data).astype(jnp.float32)]
        rest = {"published": [clock[None]], "full": [clock[None], *hidden], "untimed": []}
        return jnp.concatenate(moving + rest[self._observed])

    def displace(self, data: PhysicsState, offset: jax.Array) -> PhysicsState:
        """The ant moved by `offset` [2]; the solver corrects what gets into a wall."""
        return data.replace(qpos=data.qpos.at[:2].add(offset))

    def flipped(self, data: PhysicsState) -> jax.Array:
        """True if the torso's own up axis points down."""
        return uprightness(data.qpos[np.asarray(ORIENTATION)]) < ON_ITS_BACK

    def fallen(self, data: PhysicsState) -> jax.Array:
        """True if the torso is below half the height of the floor."""
        return data.qpos[2] < self._arena.floor_height / 2

    def unhealthy(self, data: PhysicsState) -> jax.Array:
        """True if the torso is less than .2 m or more than 1 m above the floor."""
        height, (low, high) = data.qpos[2] - self._arena.floor_height, HEALTHY
        return (height < low) | (height > high)

    def dropped(self, data: PhysicsState) -> jax.Array:
        """True if MJX-Warp ran out of room for contacts."""
        return data.overflow > 0

    def model(self) -> mujoco.MjModel:
        """The model with a checkered floor."""
        return scene.build_model(self._arena, self._spec(), {}, visual=True)

    def pose(self, data: PhysicsState) -> tuple[jax.Array, jax.Array]:
        """(qpos, mocap_pos)."""
        return data.qpos, data.mocap_pos

    def _is_open(self, data: PhysicsState) -> jax.Array:
        """True if each gate [n] is open."""
        return data.mocap_pos[:, 2] > self._closed[:, 2] + LIFT / 2

    def _at_switch(self, data: PhysicsState) -> jax.Array:
        assert self._switch is not None
        low, high = self._switch.yaw
        facing = yaw(data.qpos[np.asarray(ORIENTATION)])
        return self._switch.holds(data.qpos[:2]) & (low <= facing) & (facing <= high)
