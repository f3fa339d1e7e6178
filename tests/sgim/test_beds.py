"""How SGIM behaves where everything about learning is known: six regions, four strategies, 16 seeds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star import abstraction as regions
from star import sgim
from star.sgim import beds

BLOCKS, EPISODES = 2400, 5
AUTONOMOUS, PROCEDURE, TEACHER, BAD = range(4)


def run(*, bed=beds.SIX_REGIONS, noise=0.0, costs=(1, 1, 1, 1), absent=(), sign=1.0, later=None, seeds=16):
    """The courses of `seeds` learners, [seeds, blocks]; `sign` -1 tells them that they get worse when they learn."""
    config = sgim.Config()
    space = regions.create(((0.0,), (6.0,)), (range(1, 6),), max_regions=8)
    start = sgim.init(config, space, costs)
    available = jnp.array([s not in absent for s in range(4)])

    def select(state, *, key):
        choice = sgim.select(config, state, available, key=key)
        return choice.region, choice.strategy

    def update(state, region, strategy, competences):
        n = competences.shape[0]
        fill = lambda x: jnp.full(n, x)  # noqa: E731
        choice = sgim.Choice(fill(region), fill(strategy), fill(region)[:, None] + 0.5, fill(0), fill(0.0))
        return sgim.update(config, state, choice, sign * competences)

    def one(key):
        return beds.run(bed, start, select, update, noise=noise, blocks=BLOCKS, episodes=EPISODES, later=later, key=key)

    course = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), seeds))
    return jax.tree.map(np.asarray, course)


def mastered(course):
    """Blocks until mastery, [seeds]."""
    return np.asarray(jax.vmap(beds.until_mastered)(course))


def share(course, *, region=None, strategy=None, until=None):
    """Share of the blocks before `until` [seeds], mean over seeds."""
    counted = np.arange(BLOCKS) < (until if until is not None else np.full(len(course.region), BLOCKS))[:, None]
    hit = counted.copy()
    if region is not None:
        hit &= course.region == region
        counted = counted if strategy is None else counted & (course.region == region)
    if strategy is not None:
        hit &= course.strategy == strategy
    return (hit.sum(axis=1) / np.maximum(counted.sum(axis=1), 1)).mean()


@pytest.fixture(scope="module")
def quiet():
    return run()


def test_a_block_of_the_bed_is_that_of_a_loop():
    latent, key = np.zeros(6), jax.random.key(0)
    plan = [(0, 2), (1, 0), (0, 0), (4, 1), (3, 2)]

    def select(state, *, key):
        return jnp.array([r for r, _ in plan])[state], jnp.array([s for _, s in plan])[state]

    course = beds.run(
        beds.SIX_REGIONS, jnp.int32(0), select, lambda state, *_: state + 1, blocks=5, episodes=5, key=key
    )
    for i, (r, s) in enumerate(plan):
        for _ in range(5):
            need = beds.SIX_REGIONS.needs[r]
            if need < 0 or latent[need] > 0.7:
                latent[r] += beds.SIX_REGIONS.gain[r, s] * (1 - latent[r])
        np.testing.assert_allclose(course.regions[i], latent, rtol=1e-4)
        np.testing.assert_allclose(course.competence[i], latent[:4].mean(), rtol=1e-4)


def test_it_practises_what_is_learnable_and_soon_masters_it(quiet):
    assert quiet.competence.mean() >= 0.87  # uniform choice: .66
    assert mastered(quiet).mean() * EPISODES <= 3000  # uniform: 8,600
    assert (quiet.regions[:, -1, :4] > 0.9).all()


def test_noise_on_competence_costs_little():
    assert run(noise=0.05).competence.mean() >= 0.84


def test_it_moves_on_when_something_is_mastered(quiet):
    """The share of each region of the chain peaks after that of the one it needs."""
    windows = quiet.region[:, : 40 * (BLOCKS // 40)].reshape(len(quiet.region), -1, 40)
    peaks = [(windows == r).mean(axis=(0, 2)).argmax() for r in range(3)]
    assert peaks[0] < peaks[1] < peaks[2]


def test_it_leaves_what_cannot_be_learnt(quiet):
    until = mastered(quiet)
    assert share(quiet, region=5, until=until) <= 0.10  # uniform: .17
    assert share(quiet, region=4, until=until) <= 0.10


def test_it_learns_which_field_a_teacher_knows_and_drops_a_bad_one(quiet):
    until = mastered(quiet)
    assert share(quiet, region=3, strategy=TEACHER, until=until) >= 0.7
    assert share(quiet, region=1, strategy=PROCEDURE, until=until) > share(
        quiet, region=1, strategy=TEACHER, until=until
    )
    assert share(quiet, strategy=BAD, until=until) <= 0.14  # uniform: .25


def test_an_expensive_teacher_is_asked_less_and_an_absent_one_never(quiet):
    expensive = run(costs=(1, 1, 10, 1))
    asked = [share(course, region=0, strategy=TEACHER, until=mastered(course)) for course in (quiet, expensive)]
    assert asked[1] < 0.7 * asked[0]
    absent = run(absent=(TEACHER,), seeds=4)
    assert not (absent.strategy == TEACHER).any()
    assert (absent.regions[:, -1, :3] > 0.8).all()


def test_it_recovers_when_teacher_and_procedure_swap_what_they_teach():
    """Half-way, with learning so slow that nothing is mastered by then."""
    slow = beds.SIX_REGIONS._replace(gain=beds.SIX_REGIONS.gain / 12)
    swapped = slow._replace(gain=slow.gain[:, [AUTONOMOUS, TEACHER, PROCEDURE, BAD]])
    course = run(bed=slow, later=swapped)
    half = BLOCKS // 2
    assert (course.regions[:, half, 3] < 0.9).all()
    before = (course.region == 3) & (np.arange(BLOCKS) < half)
    after = (course.region == 3) & (np.arange(BLOCKS) >= half + 200)
    asked = [[(course.strategy == s)[when].mean() for s in (PROCEDURE, TEACHER)] for when in (before, after)]
    assert asked[0][1] > 0.5 > 0.25 > asked[0][0]
    assert asked[1][0] > 0.5 > 0.25 > asked[1][1]


def test_with_the_sign_of_progress_inverted_it_does_none_of_this():
    inverted = run(sign=-1.0)
    until = mastered(inverted)
    assert inverted.competence.mean() < 0.8
    assert until.mean() * EPISODES > 3000
    assert share(inverted, region=3, strategy=TEACHER, until=until) < 0.7
    assert share(inverted, region=5, until=until) > 0.10
    assert share(inverted, strategy=BAD, until=until) > 0.14
