"""What a refit predicts of held-out records and of parts of its own, against the same from the joint normal distribution of all rows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hvdc_ident.discrepancy.prediction import predictive_score
from hvdc_ident.fit.residual import ResidualBlock


def block(residual: np.ndarray, jacobian: np.ndarray, experiment: str = "e") -> ResidualBlock:
    return ResidualBlock(experiment, "y", np.arange(residual.size), residual, 1.0, residual, jacobian)


def fitted(design: np.ndarray, seed: int) -> np.ndarray:
    """The residual of a least-squares fit of noise by a design."""
    noise = np.random.default_rng(seed).standard_normal(len(design))
    return noise - design @ np.linalg.lstsq(design, noise, rcond=None)[0]


def expected(parts: list[np.ndarray], design: np.ndarray, residual: np.ndarray) -> float:
    """Root mean of -2 log p(part | others) + 2 log p of noise at 0: rows and unknowns are jointly normal, and so conditioned on."""
    rows = len(design)
    prior = np.linalg.inv(design.T @ design / rows)
    joint = np.eye(rows) + design @ prior @ design.T
    score = 0.0
    for own in parts:
        rest = np.setdiff1d(np.arange(rows), own)
        gain = joint[np.ix_(own, rest)] @ np.linalg.inv(joint[np.ix_(rest, rest)])
        mean, spread = gain @ residual[rest], joint[np.ix_(own, own)] - gain @ joint[np.ix_(rest, own)]
        score += -2 * multivariate_normal(mean, spread).logpdf(residual[own]) - own.size * np.log(2 * np.pi)
    return float(np.sqrt(score / rows))


@pytest.mark.parametrize("event", [False, True])
def test_parts_of_a_record_are_scored_by_their_density_given_the_others(event: bool) -> None:
    rows = 40
    design = np.column_stack([np.ones(rows), np.linspace(-1, 1, rows), np.zeros(rows)])
    design[12:18, 2] = 1.0 if event else design[12:18, 1] ** 2
    if not event:
        design[:, 2] = np.cos(np.arange(rows))
    residual = fitted(design, 3)
    parts = np.split(np.arange(rows), 4)
    # A linear model is the same about any point, and a prior about the estimate does not move it.
    assert predictive_score([block(residual, -design)], None) == pytest.approx(
        expected(parts, design, residual), rel=1e-9
    )


def test_experiments_are_left_out_whole_and_what_no_part_tells_changes_nothing() -> None:
    design = np.random.default_rng(0).standard_normal((30, 2))
    residual = fitted(design, 1)
    cuts = [np.arange(12), np.arange(12, 30)]
    alone = [block(residual[c], -design[c], str(k)) for k, c in enumerate(cuts)]
    blind = [
        block(residual[c], -np.column_stack([design, design[:, 0], np.zeros(30)])[c], str(k))
        for k, c in enumerate(cuts)
    ]
    assert predictive_score(alone, None) == pytest.approx(expected(cuts, design, residual), rel=1e-9)
    assert predictive_score(blind, None) == pytest.approx(predictive_score(alone, None), rel=1e-6)


def test_a_held_out_record_is_scored_by_its_density_given_the_fitted_ones() -> None:
    """The second unknown hardly shows in the fitted record and shows much in the other: an error along it says little."""
    random = np.random.default_rng(2)
    design, other = random.standard_normal((40, 2)) * [1.0, 0.05], random.standard_normal((25, 2)) * [1.0, 3.0]
    residual = fitted(design, 4)
    error = random.standard_normal(25) + other @ [0.0, 2.0]
    information = design.T @ design * (1 + 1 / 40)
    spread = np.eye(25) + other @ np.linalg.inv(information) @ other.T
    score = -2 * multivariate_normal(np.zeros(25), spread).logpdf(error) - 25 * np.log(2 * np.pi)
    found = predictive_score([block(residual, -design)], (block(error, -other, "other"),))
    assert found == pytest.approx(np.sqrt(score / 25), rel=1e-9)
    assert found is not None and found**2 < 0.5 * float(error @ error) / 25
