"""Movements: linear dynamic movement primitives, and minimum jerk.

A primitive moves a joint from x0, at rest, towards its goal G within T = 1 s (Ijspeert et al. 2013):

    x'' = K (G - x) - 2 sqrt(K) x' + sum_i w_i psi_i(s) s / sum_i psi_i(s),    s' = -4.6 s, s(0) = 1
    psi_i(s) = exp(-h_i (s - c_i)^2),   c_i = exp(-4.6 t_i),   h_i = 3 / c_i,   K = 150 / s^2

with t_i evenly from 0 to 1 s. It is linear in x0, G and w, so x(t) = x0 f_0(t) + G f_G(t) + sum_i w_i f_i(t): the
curves are computed once, and a movement is a product of matrices.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

WEIGHTS = 3
"""Of a movement, unless another number is asked for."""
STIFFNESS = 150.0  # 1/s^2
DECAY = 4.6  # 1/s: the phase s falls to .01 in 1 s
REACH = 0.35
"""The maximum of each curve f_i, to which they are scaled."""
SUBSTEPS = 10  # of Euler's rule in a control step


@cache
def curves(steps: int, weights: int = WEIGHTS) -> Float[np.ndarray, "steps n"]:
    """f_0, f_G, f_1, f_2 and so on after each of `steps` control steps, which last 1 s together."""
    unit = np.eye(2 + weights)
    fine = euler(unit[0], unit[1], unit[:, 2:], steps=steps * SUBSTEPS)
    fine[:, 2:] *= REACH / np.abs(fine[:, 2:]).max(axis=0)
    return fine[SUBSTEPS - 1 :: SUBSTEPS]


def euler(
    start: Float[np.ndarray, "d"], goal: Float[np.ndarray, "d"], weights: Float[np.ndarray, "d n"], *, steps: int
) -> Float[np.ndarray, "steps d"]:
    """X after each of `steps` steps of Euler's rule, which last 1 s together; d movements side by side."""
    centres = np.exp(-DECAY * np.linspace(0, 1, weights.shape[1]))
    x, speed, phase, dt, found = start.astype(float), np.zeros(len(start)), 1.0, 1 / steps, []
    for _ in range(steps):
        bumps = np.exp(-3 / centres * (phase - centres) ** 2)
        push = weights @ bumps * phase / bumps.sum()
        pull = STIFFNESS * (goal - x) - 2 * np.sqrt(STIFFNESS) * speed + push
        x, speed, phase = x + dt * speed, speed + dt * pull, phase - dt * DECAY * phase
        found.append(x)
    return np.array(found)


def rollout(
    basis: Float[Array, "steps n"], start: Float[Array, "d"], goal: Float[Array, "d"], weights: Float[Array, "d m"]
) -> Float[Array, "d steps"]:
    """The joints after each control step, in the unit of `start` and `goal`; `basis` is that of `curves`."""
    # Full precision: the H100 would else multiply with 10 bits, which is millimetres at the tip.
    return jnp.matmul(jnp.concatenate([start[:, None], goal[:, None], weights], axis=1), basis.T, precision="highest")


def minimum_jerk(share: Any) -> Any:
    """Share of the way that is covered after a `share` in [0, 1] of the time (Flash and Hogan 1985)."""
    return share**3 * (10 + share * (-15 + 6 * share))
