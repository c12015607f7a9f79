"""Figures of linear models: Bode and Nyquist diagrams, pole-zero maps, participation, mode shapes and root loci.

Every function draws a result that exists and returns the axes. The colours are Okabe and Ito's, which colour-blind readers
tell apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.colours import SERIES
from hvdc_ident.display import axes_of
from hvdc_ident.errors import unknown_name

if TYPE_CHECKING:
    from hvdc_ident.linearize.frequency import FrequencyResponse
    from hvdc_ident.linearize.linear_model import LinearModel
    from hvdc_ident.linearize.mode import Mode
    from hvdc_ident.linearize.root_loci import RootLocus

LINES = ("-", "--", "-.", ":")
MARK = "#777777"


def look(k: int) -> dict[str, Any]:
    """Colour and line of the k-th curve: they differ in both, so that a print in grey reads too."""
    return {"color": SERIES[k % len(SERIES)], "linestyle": LINES[(k // len(SERIES) + k) % len(LINES)]}


def grid(axes: Any) -> None:
    """Put light grid lines behind the curves."""
    axes.grid(True, which="both", color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)


def axes_through_zero(axes: Any) -> None:
    """Draw the real and the imaginary axis."""
    axes.axhline(0.0, color=MARK, linewidth=0.6)
    axes.axvline(0.0, color=MARK, linewidth=0.6)


def bode(responses: Sequence[FrequencyResponse], labels: Sequence[str] = (), ax: Any = None) -> Any:
    """Return the two axes, gain above phase; every channel of every response is one curve, measured ones are dots."""
    gain, phase = pair = axes_of(ax, 7.0, 6.0, rows=2)
    k = 0
    for number, r in enumerate(responses):
        name = f"{labels[number]}: " if number < len(labels) else ""
        for i, output in enumerate(r.output_names):
            for j, input in enumerate(r.input_names):
                keep = (r.omega > 0) & (r.magnitude[:, i, j] > 0)
                f, db = r.frequency_hz[keep], r.magnitude_db[keep, i, j]
                style = look(k)
                if r.source in ("recording", "simulation"):
                    style = {"color": style["color"], "linestyle": "none", "marker": ".", "markersize": 4}
                gain.semilogx(f, db, label=f"{name}{input} to {output}", **style)
                phase.semilogx(f, r.phase_deg[keep, i, j], **style)
                if r.std is not None:
                    size, spread = r.magnitude[keep, i, j], 2.0 * r.std[keep, i, j]
                    low = 20 * np.log10(np.maximum(size - spread, 1e-3 * size))
                    gain.fill_between(
                        f, low, 20 * np.log10(size + spread), color=style["color"], alpha=0.2, linewidth=0
                    )
                k += 1
    gain.set_ylabel("gain, dB")
    phase.set_ylabel("phase, degrees")
    phase.set_xlabel("frequency, Hz")
    for axes in (gain, phase):
        grid(axes)
    if k:
        gain.legend(fontsize="small")
    return pair


def nyquist(responses: Sequence[FrequencyResponse], modulus: float = 0.0, reach: float = 3.0, ax: Any = None) -> Any:
    """Return the axes; reach: how far the axes go where the curves go further. modulus: radius of the disk around -1."""
    axes = axes_of(ax, 6.0, 6.0)
    k, largest = 0, 1.5
    for r in responses:
        for i, output in enumerate(r.output_names):
            for j, input in enumerate(r.input_names):
                v = r.values[:, i, j]
                style = look(k)
                axes.plot(v.real, v.imag, label=f"{input} to {output}", **style)
                axes.plot(v.real, -v.imag, color=style["color"], linewidth=0.6)
                largest = max(largest, float(np.abs(v).max(initial=0.0)))
                k += 1
    axes.plot([-1.0], [0.0], marker="+", color="#000000", markersize=10, linestyle="none", label="-1")
    if modulus > 0:
        angle = np.linspace(0, 2 * np.pi, 200)
        axes.plot(-1 + modulus * np.cos(angle), modulus * np.sin(angle), color=MARK, linewidth=0.8)
    edge = min(largest * 1.05, reach)
    axes.set_xlim(-edge, edge)
    axes.set_ylim(-edge, edge)
    axes.set_aspect("equal")
    axes.set_xlabel("real part")
    axes.set_ylabel("imaginary part")
    axes_through_zero(axes)
    grid(axes)
    axes.legend(fontsize="small")
    return axes


def poles(model: LinearModel, ax: Any = None) -> Any:
    """Return the axes: crosses for poles, circles for invariant zeros, rad/s; a symmetric log axis where they spread."""
    axes = axes_of(ax, 6.0, 5.0)
    p, z = model.poles(), model.zeros()
    axes.plot(p.real, p.imag, "x", color=SERIES[0], markersize=8, label="poles")
    axes.plot(z.real, z.imag, "o", color=SERIES[1], markerfacecolor="none", markersize=8, label="zeros")
    if p.size and abs(p.real).max() > 100 * max(float(abs(p.imag).max()), 1.0):
        axes.set_xscale("symlog", linthresh=1.0)
    axes.set_xlabel("real part, rad/s")
    axes.set_ylabel("imaginary part, rad/s")
    axes_through_zero(axes)
    grid(axes)
    axes.legend(fontsize="small")
    return axes


def participation(modes: Sequence[Mode], ax: Any = None) -> Any:
    """Return the axes: a row for each state, a column for each mode (one of each conjugate pair), shares from 0 to 1."""
    shown = [m for m in modes if m.eigenvalue.imag >= 0]
    names = list(shown[0].participation) if shown else []
    table = np.array([[m.participation[n] for m in shown] for n in names]).reshape(len(names), len(shown))
    axes = axes_of(ax, 1.8 + 0.75 * len(shown), 1.4 + 0.32 * len(names))
    image = axes.imshow(table, cmap="cividis", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_yticks(range(len(names)), names, fontsize="small")
    labels = [f"{m.eigenvalue.real:.3g}\n{m.frequency_hz:.3g} Hz" for m in shown]
    axes.set_xticks(range(len(shown)), labels, fontsize="x-small")
    axes.set_xlabel("mode: real part in 1/s, frequency")
    for i in range(len(names)):
        for j in range(len(shown)):
            if table[i, j] >= 0.01:
                colour = "#000000" if table[i, j] > 0.5 else "#ffffff"
                axes.text(j, i, f"{table[i, j]:.2f}", ha="center", va="center", fontsize="x-small", color=colour)
    axes.figure.colorbar(image, ax=axes, label="participation")
    return axes


def shapes(mode: Mode, smallest: float = 0.01, ax: Any = None) -> Any:
    """Return the axes of one mode; entries below a share of the largest are left out."""
    axes = axes_of(ax, 5.5, 5.0)
    k = 0
    for name, value in mode.shape.items():
        if abs(value) < smallest:
            continue
        axes.plot([0.0, value.real], [0.0, value.imag], marker="o", markevery=[1], label=name, **look(k))
        k += 1
    axes.set_xlim(-1.15, 1.15)
    axes.set_ylim(-1.15, 1.15)
    axes.set_aspect("equal")
    axes.set_xlabel("real part, largest entry 1")
    axes.set_ylabel("imaginary part")
    axes.set_title(
        f"{mode.eigenvalue.real:.4g} {mode.eigenvalue.imag:+.4g}j rad/s, {mode.frequency_hz:.4g} Hz", fontsize="medium"
    )
    axes_through_zero(axes)
    grid(axes)
    axes.legend(fontsize="small")
    return axes


def locus(loci: RootLocus, left: float | None = None, ax: Any = None) -> Any:
    """Return the axes: one curve a mode, a dot at the parameter's start, a square at its end. left: edge of the axis."""
    axes = axes_of(ax, 6.5, 5.0)
    for k in range(loci.eigenvalues.shape[1]):
        v = loci.eigenvalues[:, k]
        if left is not None and v.real.max() < left:
            continue
        colour = SERIES[k % len(SERIES)]
        axes.plot(v.real, v.imag, color=colour, linewidth=1.2)
        axes.plot(v.real[:1], v.imag[:1], "o", color=colour, markersize=5)
        axes.plot(v.real[-1:], v.imag[-1:], "s", color=colour, markersize=5)
    for limit in loci.limits:
        axes.plot([limit.eigenvalue.real], [limit.eigenvalue.imag], "D", color="#000000", markersize=6)
        axes.annotate(f"{loci.parameter} = {limit.value:.4g}", (limit.eigenvalue.real, limit.eigenvalue.imag))
    if left is not None:
        axes.set_xlim(left, None)
    axes.axvline(0.0, color=MARK)
    unit = f" {loci.unit}" if loci.unit else ""
    axes.set_title(
        f"{loci.parameter} from {loci.values[0]:g} (dot) to {loci.values[-1]:g}{unit} (square)", fontsize="medium"
    )
    axes.set_xlabel("real part, rad/s")
    axes.set_ylabel("imaginary part, rad/s")
    axes_through_zero(axes)
    grid(axes)
    return axes


KINDS = ("bode", "nyquist", "poles", "participation")


def draw(model: LinearModel, kind: str = "bode", ax: Any = None) -> Any:
    """Return the axes of a drawing: "bode" (two: gain and phase, as is `ax`), "nyquist", "poles" or "participation".

    Raises UnknownNameError for another kind.
    """
    if kind == "bode":
        return bode([model.bode()], ax=ax)
    if kind == "nyquist":
        return nyquist([model.bode()], ax=ax)
    if kind == "poles":
        return poles(model, ax)
    if kind == "participation":
        return participation(model.modes(), ax)
    raise unknown_name("figure", kind, KINDS)
