"""The figure of what was measured: which curve has which axis."""

import numpy as np
from matplotlib.figure import Figure

from star.agent.kind import STAR
from star.training.figures import draw_measures

ROWS = [
    {
        "seed": seed,
        "env_steps": steps,
        "eval/success_final": 0.5,
        "eval/success_any": 1.0,
        "eval/time_at_goal": 90.0 + 20 * seed,
    }
    for steps in (100, 200)
    for seed in (0, 1)
]


def drawn(rows):
    """Each axis as its limits and the curves on it."""
    figure = Figure()
    draw_measures(figure.subplots(), rows, STAR.measures, unit=STAR.unit)
    return [(axis.get_ylim(), {line.get_label(): line.get_ydata() for line in axis.lines}) for axis in figure.axes]


def test_env_steps_at_the_goal_have_an_axis_of_their_own_beside_the_shares():
    ((low, high), shares), (others, counts) = drawn(ROWS)
    assert low < 0 < 1 < high < 1.1 and set(shares) == {"success final", "success any"}
    assert others[0] == 0 and others[1] > 110 and set(counts) == {"time at goal"}
    np.testing.assert_allclose(counts["time at goal"], [100, 100])


def test_rows_that_are_older_or_of_no_evaluation_have_one_axis():
    old = [{key: value for key, value in row.items() if "time" not in key} for row in ROWS]
    for rows, curves in ((old, 2), ([], 0)):
        (((low, high), lines),) = drawn(rows)
        assert low < 0 < 1 < high < 1.1 and len(lines) == curves
