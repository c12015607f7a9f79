"""The linear model: matrices with names, units, operating point and provenance, and the algebra of these."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from hvdc_ident.display import Shown, Table, first_rows
from hvdc_ident.errors import LinearizationError, ModelError, unknown_name
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.delays import EPS, eliminate
from hvdc_ident.linearize.descriptor import Descriptor
from hvdc_ident.linearize.point import OperatingPoint
from hvdc_ident.linearize.stability import Change, Characteristic
from hvdc_ident.linearize.system import Array

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import control

    from hvdc_ident.linearize.frequency import FrequencyResponse
    from hvdc_ident.linearize.loops import LoopMargins, Margins
    from hvdc_ident.linearize.mode import Mode
    from hvdc_ident.linearize.reduction import Reduction
    from hvdc_ident.linearize.stability import Stability
    from hvdc_ident.linearize.transfer_function import TransferFunction


Exact = TypeVar("Exact", Change, Characteristic)
SCHEMA = 1
KINDS = ("state", "input", "output")
"""What has names and units."""


@dataclass(frozen=True, eq=False)
class Gradient:
    """The derivatives of A, B, C, D by one parameter; exact: those of the equation with exact delays."""

    A: Array
    B: Array
    C: Array
    D: Array
    exact: Change | None = None

    @property
    def change(self) -> Change:
        """The derivatives of the model's equation: with its exact delays where it has any."""
        return Change(self.A, self.B, self.C, self.D, ()) if self.exact is None else self.exact


@dataclass(frozen=True, eq=False, repr=False)
class LinearModel(Shown):
    """E x' = A x + B u, y = C x + D u: deviations from the operating point, in the model's units, time in s.

    E is the identity unless the algebraic part had to stay. gradients: derivatives by parameter name. exact: the model
    before its delays were approximated, where it has any: what frequency responses and stability rest on. error: of A, relative
    to its size: rounding, or that of the differences it is made of.

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
    exact: Characteristic | None = None
    error: float = EPS
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

        def exact(m: Exact) -> Exact:
            return replace(m, given=columns(m.given), read=rows(m.read), through=rows(columns(m.through)))

        def slope(g: Gradient) -> Gradient:
            change = None if g.exact is None else exact(g.exact)
            return Gradient(g.A, columns(g.B), rows(g.C), rows(columns(g.D)), change)

        return replace(
            self,
            B=columns(self.B),
            C=rows(self.C),
            D=rows(columns(self.D)),
            gradients=FrozenMap({k: slope(g) for k, g in self.gradients.items()}),
            exact=None if self.exact is None else exact(self.exact),
            **fields,
        )

    def with_matrices(self, a: Array, b: Array, c: Array, d: Array, *, prefix: str = "x", **fields: Any) -> LinearModel:
        """Return the model with other matrices, its states numbered; delays and derivatives are not those of these matrices."""
        n = a.shape[0]
        return replace(
            self, A=a, B=b, C=c, D=d, E=np.eye(n), x0=(0.0,) * n, state_units=(),
            state_names=tuple(f"{prefix}{k + 1}" for k in range(n)), exact=None, gradients=FrozenMap(), **fields,
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

    @cached_property
    def approximate(self) -> Characteristic | Descriptor:
        """The equation of A, B, C, D and E, in which a delay stands as its Pade approximant."""
        if self.is_descriptor:
            return Descriptor(self.A, self.E, self.B, self.C, self.D)
        return Characteristic.rational(self.A, self.B, self.C, self.D, self.error)

    @property
    def equation(self) -> Characteristic | Descriptor:
        """The equation as it was linearised, its delays exact; its derivatives are `Gradient.change`."""
        return self.approximate if self.exact is None else self.exact

    @cached_property
    def characteristic(self) -> Characteristic | Descriptor:
        """The equation without delays of 0 s; poles, modes and stability rest on one search for its roots."""
        return self.approximate if self.exact is None else self.exact.without_zero_delays()

    # --- analysis: functions of other modules, imported when they are first asked for ---

    def poles(self) -> Array:
        """Return (n,) complex poles by falling real part, rad/s, hidden ones among them; for a descriptor the finite eigenvalues.

        Of a model with delays the rightmost roots of its exact characteristic equation.
        """
        from hvdc_ident.linearize.modal import poles as poles_of

        return poles_of(self)

    def stability(self) -> Stability:
        """Return whether a model is stable: with delays by its characteristic equation, else by its eigenvalues."""
        from hvdc_ident.linearize.modal import stability_of

        return stability_of(self)

    def zeros(self) -> Array:
        """Return the complex invariant zeros of a whole model, rad/s; delays are exact, see `exact_zeros`.

        A model read from a file has its delays in their Pade form, and the zeros of that.
        """
        from hvdc_ident.linearize.delayed_zeros import zeros_of

        return zeros_of(self)

    def modes(self) -> tuple[Mode, ...]:
        """Return every mode of a model, by falling real part; conjugates follow each other, the upper one first.

        A model with delays has infinitely many; these are the rightmost ones, at least as many as it has states.
        """
        from hvdc_ident.linearize.modal import modes as modes_of

        return modes_of(self)

    def transfer_function(self, input: str | None = None, output: str | None = None) -> TransferFunction:
        """Return zeros, poles and gain from an input to an output; stable pole-zero pairs that cancel are left out and listed.

        The names may be left out where there is only one. An unstable pair is never cancelled. A channel without a path is 0: no
        zeros, no poles, gain 0.
        """
        from hvdc_ident.linearize.transfer_function import transfer_function as transfer_function_of

        return transfer_function_of(self, input, output)

    def response(self, omega: Array | Sequence[float]) -> Array:
        """Return (frequencies, outputs, inputs) complex transfer matrix at omega in rad/s, delays exact."""
        from hvdc_ident.linearize.frequency import response as response_of

        return response_of(self, omega)

    def bode(
        self,
        omega: Array | Sequence[float] | None = None,
        *,
        covariance: Array | None = None,
        parameters: Sequence[str] = (),
    ) -> FrequencyResponse:
        """Return the response of every channel at omega in rad/s (default: around the poles), with units; it draws itself.

        covariance: (k, k) of parameters in their units, in the order of `parameters`, whose derivatives the model must
        have (`linearize(..., sensitivities=...)`): the response then has, as std, the first-order standard deviation of its error.
        """
        from hvdc_ident.linearize.frequency import frequency_response

        return frequency_response(self, omega, covariance=covariance, parameters=parameters)

    def sigma(self, omega: Array | Sequence[float] | None = None) -> tuple[Array, Array]:
        """Return (omega, (n, k) singular values, largest first) of the transfer matrix."""
        from hvdc_ident.linearize.frequency import sigma as sigma_of

        return sigma_of(self, omega)

    def margins(self, break_at: str | Sequence[str] | None = None) -> Margins | LoopMargins:
        """Return gain, phase, delay, modulus and disk margins; of several loops together with their common disk margin.

        break_at: the signal (or signals) of the model at which its closed loops are opened. Without it this linear model
        is taken for an open loop L with negative unit feedback. Raises LinearizationError where it is neither.
        """
        from hvdc_ident.linearize.loops import margins_of

        return margins_of(self, break_at)

    def norms(self) -> dict[str, Any]:
        """Return H2, H-infinity and L-infinity norms as plain numbers; of one that does not exist, None and the reason."""
        from hvdc_ident.linearize.norms import norms as norms_of

        return norms_of(self)

    def reduce(self, order: int | None = None, tolerance: float | None = None, *, match_dc: bool = False) -> Reduction:
        """Return a balanced model of fewer states: so many, or as few as keep the error within the tolerance. See `balanced`."""
        from hvdc_ident.linearize.reduction import reduced

        return reduced(self, order, tolerance, match_dc=match_dc)

    def save(self, path: str | Path) -> Path:
        """Write the model in the format of the path's ending, and return the path. Raises ModelError for an ending that has none."""
        from hvdc_ident.linearize.export import write

        return write(self, path)

    def plot(self, kind: str = "bode", ax: Any = None) -> Any:
        """Return the axes of a drawing: "bode" (two: gain and phase, as is `ax`), "nyquist", "poles" or "participation".

        Raises UnknownNameError for another kind.
        """
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
        """Return the model that `to_dict` wrote, its delays in their Pade form. Raises ModelError or InputError for anything else."""
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
            if "operating_point" in data:
                fields["point"] = OperatingPoint.from_dict(data["operating_point"])
            return cls(**fields, name=data["model"], provenance=FrozenMap(data.get("provenance", {})))
        except (KeyError, TypeError, ValueError) as e:
            raise ModelError(
                "the linear model is incomplete", where="linear model", got=f"{type(e).__name__}: {e}"
            ) from None


def gradient_of(model: LinearModel, parameter: str) -> Gradient:
    """Return the derivatives of A, B, C, D by a parameter; raises where the model was linearised without it."""
    if parameter not in model.gradients:
        if model.point is not None and parameter in model.point.parameters:
            raise LinearizationError(
                f"the derivatives by '{parameter}' were not asked for",
                where=f"linear model '{model.name}'",
                hint=f"linearize(..., sensitivities=['{parameter}'])",
            )
        raise unknown_name("parameter", parameter, model.gradients, where=f"linear model '{model.name}'")
    return model.gradients[parameter]


def _eigenvalue(value: complex) -> str:
    """Return an eigenvalue as text, its conjugate with it."""
    return f"{value.real:.5g} ± {value.imag:.5g}j" if value.imag else f"{value.real:.5g}"
