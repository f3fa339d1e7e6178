"""What star/tutoring computes, once more: in plain Python, one skill and one student at a time."""

import math

import numpy as np


def reachable(parents):
    """[i, j]: whether a walk along edges leads from skill i to what comes before it, j."""
    found = np.zeros_like(parents)
    for i in range(len(parents)):
        left = list(np.flatnonzero(parents[i]))
        while left:
            j = left.pop()
            if not found[i, j]:
                found[i, j] = True
                left += list(np.flatnonzero(parents[j]))
    return found


def sigma(x):
    return 1 / (1 + math.exp(-x))


def softmin(levels):
    weights = [10 ** (-level / 400) for level in levels]
    return sum(w * level for w, level in zip(weights, levels, strict=True)) / sum(weights)


def chance(parents, needed, levels, difficulty):
    """Of success in an exercise that needs the skills `needed`."""
    involved = set(needed) | {int(j) for i in needed for j in np.flatnonzero(parents[i])}
    return sigma(math.log(10) / 400 * (softmin([levels[k] for k in sorted(involved)]) - difficulty))


def practised(parents, needed, level, lasting, speed, difficulty, right):
    """(level, lasting) after an exercise that the student solved or not."""
    p = chance(parents, needed, level, difficulty)
    new, kept = [], []
    for k in range(len(level)):
        before = [level[j] for j in np.flatnonzero(parents[k])]
        ready = sigma(math.log(10) / 400 * (softmin(before) - 2000)) if before else 1.0
        growth = speed * math.exp(4 if right else 2) * 4 * p * (1 - p) * ready if k in needed else 0.0
        kept.append(min(lasting[k] + growth / 2, 2500))
        now = lasting[k] + (level[k] - lasting[k]) * math.exp(-1 / math.e) + growth
        new.append(min(max(now, kept[-1]), 2500))
    return new, kept


def features(needs, rows, rates):
    """[N][F][n]: what each student has shown of each skill before each of the rows (student, exercise, right)."""
    n, found = len(needs[0]), []
    for at, (student, _, _) in enumerate(rows):
        right, wrong, running = [0] * n, [0] * n, [[0.0] * n for _ in rates]
        for other, exercise, score in rows[:at]:
            if other != student:
                continue
            for k in np.flatnonzero(needs[exercise]):
                right[k] += score
                wrong[k] += not score
                for r, rate in enumerate(rates):
                    running[r][k] += rate * (score - running[r][k])
        counts = [[math.log(1 + x) for x in count] for count in (right, wrong)]
        found.append(counts + [[4 * x for x in one] for one in running])
    return found


def step_up(p, rate):
    """Which of m p-values Benjamini and Hochberg reject: the k smallest, for the largest k with p_(k) <= rate k / m."""
    order = sorted(range(len(p)), key=lambda i: p[i])
    most = max([k for k in range(1, len(p) + 1) if p[order[k - 1]] <= rate * k / len(p)], default=0)
    return [order.index(i) < most for i in range(len(p))]


def successes(needs, rows, students):
    """Of each student {skill: success above the mean}, by gradient descent, from rows (student, exercise, right)."""
    later = []
    for student in range(students):
        own = [row for row in rows if row[0] == student]
        later += own[(len(own) + 1) // 2 :]
    mean = {e: np.mean([r for _, f, r in later if f == e]) for e in {e for _, e, _ in later}}
    found = []
    for student in range(students):
        own = [(np.flatnonzero(needs[e]), right - mean[e]) for who, e, right in later if who == student]
        value = np.zeros(len(needs[0]))
        for _ in range(400):
            slope = value.copy()
            for needed, above in own:
                slope[needed] += value[needed].sum() - above
            value -= 0.05 * slope
        found.append({k: value[k] for needed, _ in own for k in needed})
    return found


def welch(lower, higher):
    """(difference of means, t, degrees of freedom) of two samples."""
    (a, b), (v, w) = ([f(x) for x in (lower, higher)] for f in (np.mean, lambda x: np.var(x, ddof=1) / len(x)))
    freedom = (v + w) ** 2 / (v**2 / (len(lower) - 1) + w**2 / (len(higher) - 1))
    return b - a, (b - a) / math.sqrt(v + w), freedom
