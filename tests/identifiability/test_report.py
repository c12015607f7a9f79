"""The report as an object: drawings, words, JSON."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest

from hvdc_ident.errors import ComputationError, UnknownNameError
from hvdc_ident.fit import FitParameter
from hvdc_ident.identifiability import identifiability
from tests.fit.simulators import line, recorded
from tests.identifiability.cases import closed, line_and_nothing, measured

mpl.use("Agg")
LINE = closed(line, a=0.0, b=0.0)
FREE = (FitParameter("a", 0, -50, 50), FitParameter("b", 0, -50, 50))


def runs(slopes, noise=0.05):
    return [measured(LINE, {"a": 1, "b": b}, noise, k, f"e{k}") for k, b in enumerate(slopes)]


@pytest.fixture(scope="module")
def report():
    plant = closed(line_and_nothing, a=1.0, b=1.0, c=0.0)
    free = [FitParameter("a", 0.5, 0.1, 5), FitParameter("b", 0, -5, 5), FitParameter("c", 1.0, -100, 100)]
    return identifiability(plant, [measured(plant, {"a": 1, "b": 2}, 0.01)], free, starts=1)


def test_plot_draws_on_the_axes_it_is_given_and_returns_them(report) -> None:
    import matplotlib.pyplot as plt

    figure, given = plt.subplots()
    assert report.plot(ax=given) is given
    labels = [t.get_text() for t in given.get_yticklabels()]
    assert labels == ["a\nidentifiable", "b\nidentifiable", "c\ninsensitive"]
    assert "% of the value" in given.get_xlabel()
    alone = report.plot("a")
    assert alone.get_xlabel() == "a" and alone.figure is not figure
    ends = {round(float(v), 9) for x in alone.lines for v in np.asarray(x.get_xdata(), dtype=float)}
    assert {round(v, 9) for v in report.parameters["a"].ci95} <= ends
    with pytest.raises(UnknownNameError, match="no candidate 'd'"):
        report.plot("d")
    with pytest.raises(ComputationError, match="c has no profile"):
        report.plot("c")
    plt.close("all")


def test_intervals_are_drawn_in_shares_of_what_they_are_judged_by(report) -> None:
    import matplotlib.pyplot as plt

    axes = report.plot()
    low, high = report.parameters["b"].ci95
    drawn = [np.asarray(x.get_xdata(), dtype=float) for x in axes.lines if list(x.get_ydata()) == [1, 1]]
    assert drawn[0] == pytest.approx([100 * (e - report.parameters["b"].value) / 10 for e in (low, high)])
    assert report.parameters["b"].scale == 10 and report.parameters["a"].scale == report.parameters["a"].value
    plt.close("all")


def test_words_and_notebook_show_every_verdict(report) -> None:
    said, shown = str(report), report._repr_html_()
    for n, v in report.parameters.items():
        assert v.reason in said and f"<td>{n}</td><td>{v.verdict}</td>" in shown
    assert "<table>" in shown and "Every verdict holds for these outputs" in shown


def test_the_collinearity_of_an_offset_and_a_slope_is_that_of_their_columns() -> None:
    """gamma of two columns with the cosine c is 1/sqrt(1 - c): Brun, Reichert and Kuensch, Water Resour. Res. 37 (2001) 1015."""
    data = runs([2.0])
    found = identifiability(LINE, data, FREE, starts=1).to_dict()["collinearity"]
    time = data[0].time
    cosine = time.sum() / np.sqrt(time.size * (time @ time))
    assert [pair["parameters"] for pair in found] == [["a", "b"]]
    assert found[0]["index"] == pytest.approx(1.0 / np.sqrt(1.0 - cosine), rel=1e-6)
    alone = identifiability(LINE, data, FREE[:1], held={"b": 2.0}, starts=1)
    assert alone.collinear == ()


def test_what_the_optimum_leaves_is_said_before_any_verdict() -> None:
    """A line through a wave, of which no noise is known; and one through a line, whose first line counts its verdicts alone."""
    t = np.linspace(0.0, 10.0, 120)
    plant = closed(lambda t, p: (p["a"] * t + p["b"], {"a": t, "b": np.ones_like(t)}), a=1.5, b=0.1)
    free = [FitParameter("a", 1.5, -5.0, 5.0), FitParameter("b", 0.1, -3.0, 3.0)]
    wave = identifiability(plant, [recorded("e", t, {}, y=np.sin(1.1 * t) + 0.3 * t)], free, starts=1)
    assert str(wave).startswith("The residual of y is") and "earlier rows do not foretell" in wave.pilot.doubts[0]
    straight = identifiability(plant, [measured(plant, {}, 0.1, t=t)], free, starts=1)
    told = [n for n, v in straight.parameters.items() if v.verdict == "identifiable"]
    assert (
        str(straight).startswith(f"Identifiable: {', '.join(told)} (of 2 asked about).") and straight.pilot.doubts == ()
    )
