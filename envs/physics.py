"""Rigid-body physics behind one interface, by three engines.

    native   MuJoCo in C on a thread pool, through a host callback; bit-reproducible
    jax      MJX; any accelerator, bit-reproducible
    warp     MJX-Warp; NVIDIA GPUs, by far the fastest there, not bit-reproducible

Between env steps only position, velocity, the solver's warm start and the places of mocap bodies are kept: a step
first derives everything else from them, so that a reset is complete once these are replaced. Every engine steps a
flat batch; vmaps are flattened into it (`batching.flattened`).
"""

from __future__ import annotations

import importlib.util
import os
import threading
from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from mujoco import rollout

from envs import kernels
from envs._quiet import mjx
from envs.common import extras
from envs.common.batching import flattened
from envs.common.errors import UserError
from envs.options import EnvError

CONTACTS = 24  # per environment; MJX-Warp pools them over the batch
CONSTRAINT_ROWS = 96  # per environment, MJX-Warp
SLIDE_CONTACTS = 8  # more of them for each slide joint, with 4 rows each
MIN_POOL = 512  # contacts of a batch, however small
LARGEST = 1e6  # coordinate or speed: beyond it float32 leaves out sixteenths, and learners square what they see
OVERFLOW_BITS = 0b111111  # buffers of MJX-Warp that were too small: constraint rows, contacts, convex collisions

_POOL = threading.Lock()  # mujoco.rollout has one thread pool for the process, and runs one rollout at a time


class PhysicsState(struct.PyTreeNode):
    """All that one simulation carries from step to step.

    qpos [nq], qvel [nv] and mocap_pos [nmocap, 3] are MuJoCo's. `warmstart` [nv] is the acceleration the solver
    starts from; native MuJoCo keeps it at 0 and warms up within an env step. `overflow` [] is 1.0 if contacts were
    dropped in the last step because MJX-Warp's buffers were full, else 0.0.
    """

    qpos: jax.Array
    qvel: jax.Array
    mocap_pos: jax.Array
    warmstart: jax.Array
    overflow: jax.Array


StepBatch = Callable[[PhysicsState, jax.Array], PhysicsState]


class Physics:
    """A model and the engine that steps it, `frames` time steps to an env step.

    `init` and `step` are pure functions of one simulation, for jit, scan and vmap. JAX's devices are first touched
    when `engine` or `step` is used: making a `Physics` takes no device memory.
    """

    def __init__(self, model: mujoco.MjModel, *, engine: str, frames: int):
        """`engine` is one of `options.ENGINES`; raises `EnvError` if this machine plainly lacks what it needs."""
        if engine == "warp":
            _require(nvidia=os.path.exists("/proc/driver/nvidia") or os.path.exists("/dev/nvidia0"))
        self.model = model
        self.frames = frames
        self.dt = frames * model.opt.timestep
        self.mocap_pos = model.body_pos[model.body_mocapid >= 0].astype(np.float32)
        self._wanted = engine

    @cached_property
    def engine(self) -> str:
        """The engine that is used."""
        return resolve_engine(self._wanted)

    @cached_property
    def _step(self) -> StepBatch:
        with jax.ensure_compile_time_eval():  # the first use may be inside a function that is being traced
            step = jax.jit(_ENGINES[self.engine](self.model, self.frames), inline=True)  # a batch is traced once
            return flattened(step if self.engine == "jax" else _without_derivatives(step, self.engine))

    def init(self, qpos: jax.Array, qvel: jax.Array) -> PhysicsState:
        """A simulation at rest in every respect but position [nq] and velocity [nv]; mocap bodies at their places."""
        return PhysicsState(
            qpos=qpos,
            qvel=qvel,
            mocap_pos=jnp.asarray(self.mocap_pos),
            warmstart=jnp.zeros_like(qvel),
            overflow=jnp.zeros(()),
        )

    def step(self, data: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        """`dt` seconds under constant controls [nu]. A simulation that diverges turns to NaN, and remains so."""
        batch = self._step(*jax.tree.map(lambda leaf: leaf[None], (data, ctrl)))
        after = jax.tree.map(lambda leaf: leaf[0], batch)
        sound = jnp.all(jnp.abs(after.qpos) <= LARGEST) & jnp.all(jnp.abs(after.qvel) <= LARGEST)
        return after.replace(qpos=jnp.where(sound, after.qpos, jnp.nan), qvel=jnp.where(sound, after.qvel, jnp.nan))


def _without_derivatives(step: StepBatch, engine: str) -> StepBatch:
    """`step`, which is no operation of JAX, and where a derivative is asked for a `UserError` in one line."""
    told = jax.custom_jvp(step)

    @told.defjvp
    def derivative(primals: Any, tangents: Any) -> Any:
        raise UserError(f'engine: "{engine}" has no derivatives; allowed: jax')

    return told


def resolve_engine(engine: str) -> str:
    """The engine to use on this machine: for `auto` the fastest, else `engine` itself, one of `options.ENGINES`.

    Raises:
      EnvError: if the package or the device that `warp` needs is missing.
    """
    if engine == "warp":
        _require(nvidia=_has_nvidia_gpu())
    if engine != "auto":
        return engine
    if _has_nvidia_gpu() and _has_warp():
        return "warp"
    return "native" if jax.default_backend() == "cpu" else "jax"


def _require(*, nvidia: bool) -> None:
    needs = (("an NVIDIA GPU", nvidia), (extras.install("warp"), _has_warp()))
    lacking = [need for need, met in needs if not met]
    if lacking:
        raise EnvError(f'engine "warp" needs {" and ".join(lacking)}; here choose native, jax or auto')


def _has_warp() -> bool:
    return importlib.util.find_spec("warp") is not None


def _has_nvidia_gpu() -> bool:
    return jax.default_backend() == "gpu" and "cuda" in jax.devices()[0].client.platform_version.lower()


def _native(model: mujoco.MjModel, frames: int) -> StepBatch:
    """MuJoCo in C: `mujoco.rollout` over all cores this process may use, called from the compiled program."""
    threads = [mujoco.MjData(model) for _ in os.sched_getaffinity(0)]
    split = np.cumsum([1, model.nq, model.nv])  # MuJoCo's state is time, qpos, qvel
    inputs = mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS
    idle = np.concatenate([[0.0], model.qpos0, np.zeros(model.nv + model.nu + 3 * model.nmocap)])
    duration = frames * model.opt.timestep

    def advance(*batch: Any) -> tuple[np.ndarray, np.ndarray]:
        qpos, qvel, ctrl, mocap_pos = map(np.asarray, batch)  # JAX must not be called from a callback
        places = mocap_pos.reshape(len(qpos), 3 * model.nmocap)
        start = np.hstack([np.zeros((len(qpos), 1)), qpos, qvel, ctrl, places])
        broken = ~np.isfinite(start).all(axis=1)
        start[broken] = idle  # MuJoCo would log a warning for each of them
        held = np.repeat(start[:, None, split[2] :], frames, axis=1)
        with _POOL:
            states, _ = rollout.rollout(
                model, threads, start[:, : split[2]], held, control_spec=inputs, persistent_pool=True
            )
        end = states[:, -1]
        broken |= end[:, 0] < duration - model.opt.timestep / 2  # cut short: MuJoCo found it unstable
        end[broken] = np.nan
        _, qpos, qvel = np.split(end.astype(np.float32), split[:2], axis=1)
        return qpos, qvel

    def step(data: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        shapes = tuple(jax.ShapeDtypeStruct(leaf.shape, jnp.float32) for leaf in (data.qpos, data.qvel))
        qpos, qvel = jax.pure_callback(advance, shapes, data.qpos, data.qvel, ctrl, data.mocap_pos)
        return data.replace(qpos=qpos, qvel=qvel)

    return step


def _jax(model: mujoco.MjModel, frames: int) -> StepBatch:
    """MJX in JAX, whose contact buffers cannot be too small."""
    device_model = mjx.put_model(model, impl="jax", device=_here())
    blank = mjx.make_data(model, impl="jax", device=_here())

    def step(data: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        return _mjx_step(device_model, blank, frames, lambda _: jnp.zeros(()), data, ctrl)

    return step


def _warp(model: mujoco.MjModel, frames: int) -> StepBatch:
    """MJX-Warp. Its contact buffer is shared by the batch, so blank data is made for each batch size."""
    import warp

    warp.config.log_level = warp.LOG_WARNING  # it would report every kernel that it compiles
    device_model = mjx.put_model(model, impl="warp", device=_here()).tree_replace({"opt._impl.warn_overflow": 0})

    slides = int((model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE).sum())
    contacts = CONTACTS + slides * SLIDE_CONTACTS
    rows = CONSTRAINT_ROWS + slides * 4 * SLIDE_CONTACTS
    kernels.compile_beside(model, contacts=MIN_POOL, rows=rows)

    def overflow(full: mjx.Data) -> jax.Array:
        return ((full._impl.overflow & OVERFLOW_BITS) != 0).astype(jnp.float32)

    def step(data: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        with jax.ensure_compile_time_eval():
            pool = max(len(ctrl) * contacts, MIN_POOL)
            blank = mjx.make_data(model, impl="warp", device=_here(), naconmax=pool, njmax=rows)
        return _mjx_step(device_model, jax.tree.map(_as_fill, blank), frames, overflow, data, ctrl)

    return step


def _here() -> jax.Device:
    """A device whose arrays this process can read, as compiling them in needs; MJX would take the first of all."""
    return jax.local_devices()[0]


def _as_fill(leaf: jax.Array) -> jax.Array:
    """`leaf` as an operation if it holds a single value, since buffers of a whole batch make huge constants."""
    host = np.asarray(leaf)
    uniform = host.size > 1 and (host == host.flat[0]).all()
    return jnp.full(host.shape, host.flat[0], host.dtype) if uniform else leaf


def _mjx_step(
    model: mjx.Model,
    blank: mjx.Data,
    frames: int,
    overflow: Callable[[mjx.Data], jax.Array],
    data: PhysicsState,
    ctrl: jax.Array,
) -> PhysicsState:
    """Step the batch [n], each simulation starting from `blank`; `overflow` reads the flag off the last frame."""

    def simulate(data: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        full = blank.replace(
            qpos=data.qpos, qvel=data.qvel, mocap_pos=data.mocap_pos, qacc_warmstart=data.warmstart, ctrl=ctrl
        )
        full = jax.lax.fori_loop(0, frames, lambda _, full: mjx.step(model, full), full)
        return PhysicsState(full.qpos, full.qvel, data.mocap_pos, full.qacc_warmstart, overflow(full))

    # The dynamics need whole float32 products, which NVIDIA GPUs do not give by default.
    with jax.default_matmul_precision("highest"):
        return jax.vmap(simulate)(data, ctrl)


_ENGINES: dict[str, Callable[[mujoco.MjModel, int], StepBatch]] = {"native": _native, "jax": _jax, "warp": _warp}
