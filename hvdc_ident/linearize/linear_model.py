"""The linear model: matrices with names, units, operating point and provenance, and its analysis as methods."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.display import Shown, Table, first_rows
from hvdc_ident.errors import LinearizationError, ModelError, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.delays import DelayFreePart, eliminate
from hvdc_ident.linearize.operating_point import OperatingPoint
from hvdc_ident.linearize.system import Array

if TYPE_CHECKING:
    import control

    from hvdc_ident.linearize.frequency import FrequencyResponse
    from hvdc_ident.linearize.loops import LoopMargins, Margins
    from hvdc_ident.linearize.modal import Mode
    from hvdc_ident.linearize.reduction import Reduction
    from hvdc_ident.linearize.stability import Characteristic, Stability
    from hvdc_ident.linearize.transfer_function import TransferFunction


SCHEMA = 1
KINDS = ("state", "input", "output")
"""What has names and units."""


@dataclass(frozen=True, eq=False)
class Gradient:
    """The derivatives of A, B, C, D by one parameter; delay_free and times: those of the exact delayed model."""

    A: Array
    B: Array
    C: Array
    D: Array
    delay_free: Array | None = None
    times: tuple[Array, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class LinearModel(Shown):
    """E x' = A x + B u, y = C x + D u: deviations from the operating point, in the model's units, time in s.

    E is the identity unless the algebraic part had to stay. gradients: derivatives by parameter name. delay_free: the
    model before its delays were approximated, where it has any: what frequency responses are exact with.

    Raises LinearizationError where the matrices' sizes do not fit, or an entry is not finite.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    E: Array
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    state_units: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    point: OperatingPoint | None = None
    name: str = "model"
    provenance: FrozenMap[str] = field(default_factory=FrozenMap)
    gradients: FrozenMap[Gradient] = field(default_factory=FrozenMap)
    delay_free: DelayFreePart | None = None
    x0: tuple[float, ...] = ()
    u0: tuple[float, ...] = ()
    y0: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        n, m, o = len(self.state_names), len(self.input_names), len(self.output_names)
        for key, shape in (("A", (n, n)), ("B", (n, m)), ("C", (o, n)), ("D", (o, m)), ("E", (n, n))):
            array = np.array(getattr(self, key), dtype=float)
            if array.shape != shape:
                if array.size != shape[0] * shape[1]:
                    raise LinearizationError(
                        f"{key} does not fit the names", where=self.name, expected=f"{shape}", got=f"{array.shape}"
                    )
                array = array.reshape(shape)
            if not np.isfinite(array).all():
                raise LinearizationError(f"{key} has an entry that is not finite", where=self.name)
            array.setflags(write=False)
            object.__setattr__(self, key, array)
        for key, size in (("state_units", n), ("input_units", m), ("output_units", o)):
            if not getattr(self, key):
                object.__setattr__(self, key, ("",) * size)
        self._fill_values()

    def _fill_values(self) -> None:
        point = self.point
        known: dict[str, float] = {}
        if point is not None:
            known = {**point.states, **point.unknowns, **point.extras}
        if not self.x0:
            object.__setattr__(self, "x0", tuple(known.get(s, 0.0) for s in self.state_names))
        inputs = {} if point is None else point.inputs
        if not self.u0:
            object.__setattr__(self, "u0", tuple(inputs.get(s, 0.0) for s in self.input_names))
        if not self.y0:
            outputs = {} if point is None else {**known, **point.inputs, **point.outputs}
            object.__setattr__(self, "y0", tuple(outputs.get(s, 0.0) for s in self.output_names))

    # --- views ---

    @property
    def is_descriptor(self) -> bool:
        """True where E is not the identity."""
        return not np.array_equal(self.E, np.eye(self.A.shape[0]))

    def standard(self) -> tuple[Array, Array, Array, Array]:
        """Return A, B, C, D of the model with E = 1: its algebraic part eliminated, or E inverted.

        The zero rows of E = diag(1, ..., 0, ...) are eliminated; any other E is inverted. Raises LinearizationError
        where the matrix to invert is singular.
        """
        if not self.is_descriptor:
            return self.A, self.B, self.C, self.D
        e, n = self.E, self.A.shape[0]
        k = int(np.count_nonzero(np.diag(e)))
        if np.array_equal(e, np.diag([1.0] * k + [0.0] * (n - k))):
            top = np.block([[self.A[:k, :k], self.B[:k]], [self.C[:, :k], self.D]])
            right = np.concatenate([self.A[:k, k:], self.C[:, k:]])
            bottom = np.concatenate([self.A[k:, :k], self.B[k:]], axis=1)
            reduced = eliminate(
                np.block([[top, right], [bottom, self.A[k:, k:]]]), k + self.C.shape[0], k + self.B.shape[1]
            )
            if reduced.condition < 1e14:
                r = reduced.result
                return r[:k, :k], r[:k, k:], r[k:, :k], r[k:, k:]
            condition = reduced.condition
        else:
            condition = float(np.linalg.cond(e))
            if condition < 1e12:
                return np.linalg.solve(e, self.A), np.linalg.solve(e, self.B), self.C, self.D
        raise LinearizationError(
            "the algebraic part cannot be eliminated",
            where=f"linear model '{self.name}'",
            got=f"condition number {condition:.2g}",
            hint="use poles(), zeros of the pencil and the frequency response, which take E as it is",
        )

    def channel(self, inputs: Sequence[str] | str, outputs: Sequence[str] | str) -> LinearModel:
        """Return the model between some of its inputs and outputs; the states stay."""
        i = [self._index("input", n) for n in ([inputs] if isinstance(inputs, str) else inputs)]
        o = [self._index("output", n) for n in ([outputs] if isinstance(outputs, str) else outputs)]
        return self._rewired(
            lambda columns: columns[:, i],
            lambda rows: rows[o],
            input_names=tuple(self.input_names[k] for k in i),
            output_names=tuple(self.output_names[k] for k in o),
            input_units=tuple(self.input_units[k] for k in i),
            output_units=tuple(self.output_units[k] for k in o),
            u0=tuple(self.u0[k] for k in i),
            y0=tuple(self.y0[k] for k in o),
        )

    def negated(self) -> LinearModel:
        """Return the model whose outputs have the other sign."""
        return self._rewired(lambda columns: columns, lambda rows: -rows)

    def _rewired(self, columns: Callable[[Array], Array], rows: Callable[[Array], Array], **fields: Any) -> LinearModel:
        """Return the model with the columns of its inputs and the rows of its outputs changed, in every matrix it has."""
        core = self.delay_free

        def whole(m: Array) -> Array:
            assert core is not None
            n, u, y = core.nx, core.nx + core.nu, core.nx + core.no
            m = np.concatenate([m[:, :n], columns(m[:, n:u]), m[:, u:]], axis=1)
            return np.concatenate([m[:n], rows(m[n:y]), m[y:]])

        gradients = {
            k: Gradient(
                g.A, columns(g.B), rows(g.C), rows(columns(g.D)),
                None if g.delay_free is None else whole(g.delay_free), g.times,
            )
            for k, g in self.gradients.items()
        }  # fmt: skip
        d = rows(columns(self.D))
        if core is not None:
            core = replace(core, matrix=whole(core.matrix), no=d.shape[0], nu=d.shape[1])
        return replace(
            self,
            B=columns(self.B),
            C=rows(self.C),
            D=d,
            gradients=FrozenMap(gradients),
            delay_free=core,
            **fields,
        )

    def with_matrices(self, a: Array, b: Array, c: Array, d: Array, *, prefix: str = "x", **fields: Any) -> LinearModel:
        """Return the model with other matrices, its states numbered; delays and derivatives are not those of these matrices."""
        n = a.shape[0]
        return replace(
            self, A=a, B=b, C=c, D=d, E=np.eye(n), x0=(0.0,) * n, state_units=(),
            state_names=tuple(f"{prefix}{k + 1}" for k in range(n)), delay_free=None, gradients=FrozenMap(), **fields,
        )  # fmt: skip

    def _index(self, kind: str, name: str) -> int:
        names = self.input_names if kind == "input" else self.output_names
        if name not in names:
            raise unknown_name(kind, name, names, where=f"linear model '{self.name}'")
        return names.index(name)

    def scaled(self, sizes: Mapping[str, float]) -> LinearModel:
        """Return the model with some inputs and outputs counted in other units: 1 is then the size given for it.

        sizes: by input or output, in its unit. Raises UnknownNameError, LinearizationError for a size not above 0.
        """
        for name, size in sizes.items():
            if name not in self.input_names and name not in self.output_names:
                known = (*self.input_names, *self.output_names)
                raise unknown_name("input or output", name, known, where=f"linear model '{self.name}'")
            if not (np.isfinite(size) and size > 0):
                raise LinearizationError("a size is not above 0", where=f"scale of '{name}'", got=f"{size:g}")
        u = np.array([sizes.get(n, 1.0) for n in self.input_names])
        y = np.array([sizes.get(n, 1.0) for n in self.output_names])[:, None]

        def units(names: tuple[str, ...], own: tuple[str, ...]) -> tuple[str, ...]:
            return tuple(f"{sizes[k]:g} {v}".strip() if k in sizes else v for k, v in zip(names, own, strict=True))

        return self._rewired(
            lambda columns: columns * u,
            lambda rows: rows / y,
            input_units=units(self.input_names, self.input_units),
            output_units=units(self.output_names, self.output_units),
            u0=tuple(v / k for v, k in zip(self.u0, u, strict=True)),
            y0=tuple(v / k for v, k in zip(self.y0, y[:, 0], strict=True)),
        )

    def to_control(self) -> control.StateSpace:
        """Return a python-control StateSpace with the same names; delays are in their Pade form."""
        import control

        a, b, c, d = self.standard()
        names = self.state_names[: a.shape[0]]
        return control.StateSpace(
            a, b, c, d, name=self.name, remove_useless_states=False,
            states=list(names), inputs=list(self.input_names), outputs=list(self.output_names),
        )  # fmt: skip

    # --- analysis ---

    @cached_property
    def characteristic(self) -> Characteristic:
        """The exact characteristic equation of a model with delays; poles, modes and stability rest on one search for its roots."""
        from hvdc_ident.linearize.stability import Characteristic as Equation

        assert self.delay_free is not None
        return Equation.of(self.delay_free.without_zero_delays())

    def poles(self) -> Array:
        """Return (states,) complex eigenvalues in rad/s; those of the pencil without the infinite ones for a descriptor.

        With delays: the rightmost roots of the exact characteristic equation, at least one for each state and five for each delay.
        """
        from hvdc_ident.linearize.modal import poles

        return poles(self)

    def stability(self) -> Stability:
        """Return the verdict on stability, delays exact, with the number of roots right of the imaginary axis."""
        from hvdc_ident.linearize.modal import stability_of

        return stability_of(self)

    def zeros(self) -> Array:
        """Complex invariant zeros of the whole system, rad/s."""
        from hvdc_ident.linearize.transfer_function import zeros

        return zeros(*self.standard())

    def modes(self) -> tuple[Mode, ...]:
        """Every mode: eigenvalue, frequency, damping, participation, shape, and its derivative by known parameters."""
        from hvdc_ident.linearize.modal import modes

        return modes(self)

    def transfer_function(self, input: str | None = None, output: str | None = None) -> TransferFunction:
        """Zeros, poles and gain from an input to an output; the names may be left out where there is only one."""
        from hvdc_ident.linearize.transfer_function import transfer_function

        return transfer_function(self, input or self._only("input"), output or self._only("output"))

    def _only(self, kind: str) -> str:
        names = self.input_names if kind == "input" else self.output_names
        if len(names) != 1:
            raise LinearizationError(
                f"which {kind}?", where=f"linear model '{self.name}'", expected=f"one of {', '.join(names)}"
            )
        return names[0]

    def response(self, omega: Array) -> Array:
        """Return (frequencies, outputs, inputs) complex transfer matrix at omega in rad/s, delays exact."""
        from hvdc_ident.linearize.frequency import transfer

        return transfer(self, 1j * np.atleast_1d(np.asarray(omega, dtype=float)))

    def bode(
        self,
        omega: Array | None = None,
        *,
        covariance: Array | None = None,
        parameters: Sequence[str] = (),
    ) -> FrequencyResponse:
        """Return the frequency response at omega in rad/s (default: around the poles), with units; it draws itself.

        covariance: (k, k) of parameters in their units, in the order of `parameters`, whose derivatives the model must
        have (`linearize(..., sensitivities=...)`): the response then has the standard deviation that follows, as a band.
        """
        from hvdc_ident.linearize.frequency import bands, default_omega, frequency_response

        if covariance is None:
            return frequency_response(self, omega)
        return bands(self, default_omega(self) if omega is None else omega, covariance, parameters)

    def sigma(self, omega: Array | None = None) -> tuple[Array, Array]:
        """Return (omega, singular values), (n,) and (n, k), largest first, of the transfer matrix."""
        from hvdc_ident.linearize.frequency import sigma

        return sigma(self, omega)

    def margins(self, break_at: str | Sequence[str] | None = None) -> Margins | LoopMargins:
        """Return gain, phase, delay, modulus and disk margins; of several loops together with their common disk margin.

        break_at: the signal (or signals) of the model at which its closed loops are opened. Without it this linear model
        is taken for an open loop L with negative unit feedback. Raises LinearizationError where it is neither.
        """
        from hvdc_ident.linearize.loops import loop, loop_margins, margins
        from hvdc_ident.model import Model

        if break_at is None:
            return margins(self) if self.B.shape[1] == self.C.shape[0] == 1 else loop_margins(self)
        if self.point is None or not isinstance(self.point.model, Model):
            raise LinearizationError(
                "a loop can be opened only in a model with equations",
                where=f"linear model '{self.name}'",
                hint="margins() without a signal takes this linear model for the open loop",
            )
        opened = loop(self.point.model, break_at, self.point)
        return margins(opened) if isinstance(break_at, str) else loop_margins(opened)

    def norms(self) -> dict[str, Any]:
        """Return the H2, H-infinity and L-infinity norms, None with the reason where one does not exist."""
        from hvdc_ident.linearize.reduction import norms

        return norms(self)

    def reduce(self, order: int | None = None, tolerance: float | None = None, *, match_dc: bool = False) -> Reduction:
        """Return a balanced model of fewer states: so many, or as few as keep the error within the tolerance.

        See `hvdc_ident.linearize.reduction.balanced`.
        """
        from hvdc_ident.linearize.reduction import balanced

        return balanced(self, order, tolerance, match_dc=match_dc)

    def save(self, path: str | Path) -> Path:
        """Write the model in the format of the path's ending (.mat, .json, .csv, .m, .mo) and return the path."""
        from hvdc_ident.linearize.export import write

        return write(self, path)

    def plot(self, kind: str = "bode", ax: Any = None) -> Any:
        """Return the axes of a drawing: "bode" (two: gain and phase, as is `ax`), "nyquist", "poles" or "participation"."""
        from hvdc_ident.linearize.plot import draw

        return draw(self, kind, ax)

    def _screen(self) -> Iterator[str | Table]:
        def listed(names: tuple[str, ...]) -> str:
            return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")

        yield f"Linear model of {self.name}: {len(self.state_names)} states, {self.stability().verdict}"
        lines = [f"inputs {listed(self.input_names)}; outputs {listed(self.output_names)}"]
        if "values" in self.provenance:
            lines.append(f"at the {self.provenance['values']}")
        yield "\n".join(lines)
        modes = [m for m in self.modes() if m.eigenvalue.imag >= 0]
        rows = [(_eigenvalue(m.eigenvalue), m.frequency_hz, m.damping, m.dominant) for m in modes]
        yield from first_rows(("eigenvalue, 1/s", "Hz", "damping", "mostly"), rows, "modes", 20)

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain lists, with names, units, operating point and provenance."""
        point = {} if self.point is None else {"operating_point": self.point.to_dict()}
        return {
            "schema": SCHEMA,
            "kind": "linear-model",
            "model": self.name,
            "equation": "E dx/dt = A x + B u, y = C x + D u, deviations from x0, u0, y0; time in s",
            **{k: getattr(self, k).tolist() for k in "ABCDE"},
            **{f"{k}_{w}": list(getattr(self, f"{k}_{w}")) for w in ("names", "units") for k in KINDS},
            **{k: list(getattr(self, k)) for k in ("x0", "u0", "y0")},
            "provenance": dict(self.provenance),
            **point,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LinearModel:
        """Return the model that `to_dict` wrote, without its operating point. Raises ModelError for anything else."""
        if not isinstance(data, Mapping) or data.get("schema") != SCHEMA or "A" not in data:
            raise ModelError(
                "this is no linear model",
                where="linear model",
                expected=f"a JSON object with schema {SCHEMA} and A, B, C, D",
            )
        try:
            fields: dict[str, Any] = {k: data[k] for k in "ABCDE"}
            fields |= {f"{k}_{w}": tuple(data[f"{k}_{w}"]) for k in KINDS for w in ("names", "units")}
            fields |= {k: tuple(data[k]) for k in ("x0", "u0", "y0")}
            return cls(**fields, name=data["model"], provenance=FrozenMap(data.get("provenance", {})))
        except (KeyError, TypeError, ValueError) as e:
            raise ModelError(
                "the linear model is incomplete", where="linear model", got=f"{type(e).__name__}: {e}"
            ) from None


def _eigenvalue(value: complex) -> str:
    """Return an eigenvalue as text, its conjugate with it."""
    return f"{value.real:.5g} ± {value.imag:.5g}j" if value.imag else f"{value.real:.5g}"
