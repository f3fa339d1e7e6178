"""How SGIM behaves where everything about learning is known: six regions, four strategies, 16 seeds."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star import sgim
from star.abstraction import regions
from star.sgim import beds, selectors

BLOCKS, EPISODES = 2400, 5
AUTONOMOUS, PROCEDURE, TEACHER, BAD = range(4)


@jax.jit
def courses(keys, noise, gains, late_gains, costs, available, sign):
    bed = beds.six_regions(noise=noise, gains=gains, late_gains=late_gains)
    rule = selectors.sgim(sgim.Config(), bed.regions, [1.0] * 4, available)
    told = rule._replace(
        state=rule.state.replace(costs=costs),
        update=lambda state, r, s, goals, c: rule.update(state, r, s, goals, sign * c),
    )
    return jax.vmap(lambda key: beds.run(bed, told, blocks=BLOCKS, episodes=EPISODES, key=key))(keys)


def run(*, noise=0.0, gains=beds.GAINS, late_gains=None, costs=(1, 1, 1, 1), absent=(), sign=1.0):
    """The courses of 16 learners, [seeds, blocks]; `sign` -1 tells them that they get worse when they learn."""
    tables = np.float32(gains), np.float32(gains if late_gains is None else late_gains)
    available = np.array([s not in absent for s in range(4)])
    keys = jax.random.split(jax.random.key(0), 16)
    return jax.device_get(courses(keys, noise, *tables, np.float32(costs), available, sign))


MASTERED = jax.jit(jax.vmap(beds.until_mastered))


def mastered(course):
    """Blocks until mastery, [seeds]."""
    return np.asarray(MASTERED(course))


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
    latent, plan = np.zeros(6), [(0, 2), (1, 0), (0, 0), (4, 1), (3, 2)]
    region, strategy = jnp.asarray(np.array(plan).T)
    fixed = selectors.Selector(
        state=jnp.int32(0),
        select=lambda state, *, key: (region[state], strategy[state]),
        update=lambda state, *_: state + 1,
    )
    course = jax.jit(lambda key: beds.run(beds.six_regions(), fixed, blocks=5, episodes=5, key=key))(jax.random.key(0))
    course = jax.device_get(course)
    for i, (r, s) in enumerate(plan):
        for _ in range(5):
            if r not in (1, 2) or latent[r - 1] > 0.7:
                latent[r] += beds.GAINS[r, s] * (1 - latent[r])
        np.testing.assert_allclose(course.latent[i], latent, rtol=1e-4)
        np.testing.assert_allclose(course.mastery[i], latent[:4].mean(), rtol=1e-4)


def test_goals_are_drawn_in_the_region_that_was_chosen():
    bed = beds.frontier()
    told = selectors.Selector(
        state=jnp.int32(0),
        select=lambda state, *, key: (state, jnp.int32(0)),
        update=lambda state, *_: state + 1,
    )
    noted = bed._replace(play=lambda latent, r, s, goals, late, *, key: (goals, goals[:, 0]), start=jnp.zeros((5, 2)))
    noted = noted._replace(mastery=lambda goals: goals[0, 0])

    @jax.jit
    def located(key):
        course = beds.run(noted, told, blocks=36, key=key)
        return jax.vmap(jax.vmap(partial(regions.locate, bed.regions)))(course.latent)

    np.testing.assert_array_equal(located(jax.random.key(0)), np.repeat(np.arange(36)[:, None], 5, axis=1))


def test_it_practises_what_is_learnable_and_soon_masters_it(quiet):
    assert quiet.mastery.mean() >= 0.87  # uniform choice: .66
    assert mastered(quiet).mean() * EPISODES <= 3000  # uniform: 8,600
    assert (quiet.latent[:, -1, :4] > 0.9).all()


def test_noise_on_competence_costs_little():
    assert run(noise=0.05).mastery.mean() >= 0.84


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
    absent = run(absent=(TEACHER,))
    assert not (absent.strategy == TEACHER).any()
    assert (absent.latent[:, -1, :3] > 0.8).all()


def test_it_recovers_when_teacher_and_procedure_swap_what_they_teach():
    """Half-way, with learning so slow that nothing is mastered by then."""
    gains = beds.GAINS / 12
    swapped = gains[:, [AUTONOMOUS, TEACHER, PROCEDURE, BAD]]
    course = run(gains=gains, late_gains=swapped)
    half = BLOCKS // 2
    assert (course.latent[:, half, 3] < 0.9).all()
    before = (course.region == 3) & (np.arange(BLOCKS) < half)
    after = (course.region == 3) & (np.arange(BLOCKS) >= half + 200)
    asked = [[(course.strategy == s)[when].mean() for s in (PROCEDURE, TEACHER)] for when in (before, after)]
    assert asked[0][1] > 0.5 > 0.25 > asked[0][0]
    assert asked[1][0] > 0.5 > 0.25 > asked[1][1]


def test_with_the_sign_of_progress_inverted_it_does_none_of_this():
    inverted = run(sign=-1.0)
    until = mastered(inverted)
    assert inverted.mastery.mean() < 0.8
    assert until.mean() * EPISODES > 3000
    assert share(inverted, region=3, strategy=TEACHER, until=until) < 0.7
    assert share(inverted, region=5, until=until) > 0.10
    assert share(inverted, strategy=BAD, until=until) > 0.14
