"""A look at an FMU: its variables, what it offers, and what a short run of it finds."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.codec import Coded, stored_as
from hvdc_ident.errors import HvdcIdentError, ModelError
from hvdc_ident.fmu.archive import check_archive
from hvdc_ident.fmu.description import (
    Description,
    Variable,
    check_binary,
    has_sources,
    platforms,
    read_description,
)
from hvdc_ident.immutable import FrozenMap

if TYPE_CHECKING:
    from hvdc_ident.data import Array
    from hvdc_ident.fmu.model import FmuModel

ROWS_SHOWN = 15  # of one group of variables, where not all are asked for: the groups together fill about a screen
SHORT_RUN = 0.1  # length of the test run, in shares of the default experiment's
GROUPS = {
    "inputs": "inputs",
    "outputs": "outputs, recorded where nothing else is named",
    "parameters": "parameters, which can be estimated",
    "states": "states, which can be recorded",
    "others": "further variables, which can be recorded",
}
OFFERS = {
    "variable communication steps": "canHandleVariableCommunicationStepSize",
    "fixed internal step, s": "fixedInternalStepSize",
    "directional derivatives": "providesDirectionalDerivative",
    "interpolated inputs": "canInterpolateInputs",
    "state access": "canGetAndSetFMUstate",
    "serialised state": "canSerializeFMUstate",
    "only one instance per process": "canBeInstantiatedOnlyOncePerProcess",
    "needs its tool": "needsExecutionTool",
}
"""Attributes of FMI, by the words for them."""
LEARNED = {
    "brought back to its start by": "restart",
    "slopes of inputs": "sloping",
    "communication steps": "steps",
    "reading outputs after a jump": "reading",
}
"""Keys of what the pool has learned in its runs, by the words for them."""


@dataclass(frozen=True)
class Capabilities(Coded):
    """An FMU as it describes itself, and as test runs show it.

    file: its name. interfaces: values of OFFERS by the kinds of interface that it has. platforms: libraries by folder. problem: why it
    cannot be used on this machine, "" where it can. experiment: start, stop, tolerance and step of its default, where
    given. groups: variables by GROUPS; sizes: their numbers. arrays: sizes of variables that are arrays. unused:
    variables that are no numbers. found: results of test runs, in words by subject.
    """

    file: str
    name: str
    fmi: str
    tool: str
    date: str
    description: str
    interfaces: FrozenMap[FrozenMap[Any]]
    platforms: FrozenMap[tuple[str, ...]]
    sources: bool
    problem: str
    experiment: FrozenMap[float]
    indicators: int
    log_categories: tuple[str, ...]
    groups: FrozenMap[FrozenMap[Variable]] = field(metadata=stored_as("variables"))
    sizes: FrozenMap[int]
    arrays: FrozenMap[str] = field(default_factory=FrozenMap)
    unused: tuple[str, ...] = ()
    found: FrozenMap[str] = field(default_factory=FrozenMap)
    schema: int = 1

    def matching(self, text: str) -> Capabilities:
        """Return a copy with only the variables that have the text in name, unit or description, in any case."""
        part = text.casefold()

        def holds(v: Variable) -> bool:
            return any(part in t.casefold() for t in (v.name, v.unit, v.description, *v.also))

        return replace(
            self,
            groups=FrozenMap(
                {g: FrozenMap({n: v for n, v in vs.items() if holds(v)}) for g, vs in self.groups.items()}
            ),
            arrays=FrozenMap({n: s for n, s in self.arrays.items() if part in n.casefold()}),
            unused=tuple(n for n in self.unused if part in n.casefold()),
        )

    def text(self, rows: int | None = ROWS_SHOWN) -> str:
        """Return it as text. rows: of each group that are shown, None for all."""
        return "\n".join([*self._heading(), *self._abilities(), *self._listed(rows)])

    def __str__(self) -> str:
        return self.text()

    def _heading(self) -> list[str]:
        made = f", made by {self.tool}" if self.tool else ""
        libraries = [f"{p}{'' if files else ' (empty)'}" for p, files in self.platforms.items()]
        sizes = ", ".join(f"{n} {'other variables' if g == 'others' else g}" for g, n in self.sizes.items())
        lines = [
            f"{self.file}: model {self.name}, FMI {self.fmi}{made}{f', {self.date}' if self.date else ''}",
            *([f"  {self.description}"] if self.description else []),
            f"  offers {', '.join(self.interfaces) or 'neither model exchange nor co-simulation'}; binaries: "
            f"{', '.join(libraries) or 'none'}{'; C sources' if self.sources else ''}",
            f"  on this machine: {self.problem or 'it can be run'}",
            f"  {sizes}, {self.indicators} event indicators",
        ]
        if self.experiment:
            lines.append("  default experiment: " + ", ".join(f"{k} {v:g}" for k, v in self.experiment.items()))
        if self.log_categories:
            lines.append(f"  log categories: {', '.join(self.log_categories)}")
        return lines

    def _abilities(self) -> list[str]:
        lines = []
        for kind, offers in self.interfaces.items():
            words = [f"{k} {v if not isinstance(v, bool) else 'yes' if v else 'no'}" for k, v in offers.items()]
            lines.append(f"  {kind} says: {', '.join(words)}")
        return [*lines, *(f"  found: {subject}: {words}" for subject, words in self.found.items())]

    def _listed(self, rows: int | None) -> list[str]:
        lines = ["", "by name, causality, variability, unit, start, [min, max], description:"]
        for group, variables in self.groups.items():
            if not variables:
                continue
            shown = list(variables.values())[:rows]
            table = [_cells(v) for v in shown]
            widths = [min(max(len(row[k]) for row in table), 48) for k in range(len(table[0]) - 1)]
            lines += ["", f"{GROUPS[group]} ({len(variables)})"]
            for row in table:
                padded = "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=False))
                lines.append(f"  {padded}  {row[-1]}".rstrip())
            if len(variables) > len(shown):
                lines.append(f"  ... and {len(variables) - len(shown)} more")
        if self.arrays:
            sizes = [f"{n} ({s})" for n, s in self.arrays.items()][:rows]
            lines += [
                "",
                f"arrays, which stay at their start and are not recorded ({len(self.arrays)})",
                f"  {', '.join(sizes)}",
            ]
        if self.unused:
            lines += ["", f"no numbers, not used ({len(self.unused)})", f"  {', '.join(self.unused[:rows])}"]
        return lines


def _cells(v: Variable) -> tuple[str, ...]:
    start = "" if v.start is None else f"{v.start:g}"
    bounds = "" if not np.isfinite([v.min, v.max]).any() else f"[{v.min:g}, {v.max:g}]"
    also = f" (also {', '.join(v.also)})" if v.also else ""
    return v.name, v.causality, v.variability, v.unit, start, bounds, " ".join(f"{v.description}{also}".split())


def read_capabilities(path: str | Path) -> Capabilities:
    """Return an FMU's capabilities as it describes them, without running it. Raises ModelError for no FMU of FMI 2.0 or 3.0."""
    file = Path(path)
    names = check_archive(file)
    d = read_description(file, binary=False)
    groups = _groups(d)
    try:
        check_binary(file, names, d.version, d.identifier)
        problem = ""
    except ModelError as e:
        problem = f"{e.what}, but {e.got}"
    stated = {k: {words: s[a] for words, a in OFFERS.items() if a in s} for k, s in d.interfaces.items()}
    return Capabilities(
        file=file.name,
        name=d.name,
        fmi=d.fmi,
        tool=d.tool,
        date=d.date,
        description=" ".join(d.text.split()),
        interfaces=FrozenMap({str(k): FrozenMap(s) for k, s in stated.items()}),
        platforms=FrozenMap({k: tuple(v) for k, v in platforms(names).items()}),
        sources=has_sources(names),
        problem=problem,
        experiment=d.experiment,
        indicators=d.indicators,
        log_categories=d.log_categories,
        groups=groups,
        sizes=FrozenMap({g: len(vs) for g, vs in groups.items()} | {"states": d.state_count}),
        arrays=d.arrays,
        unused=d.unused,
    )


def _groups(d: Description) -> FrozenMap[FrozenMap[Variable]]:
    """Return the variables by GROUPS, each in one; states under the names that the model structure has for them."""
    outputs = {n: d.variable(n) for n in d.shown} if d.outputs else {}
    states = d.states or ({} if d.outputs else {n: d.variable(n) for n in d.shown})
    states = {n: v for n, v in states.items() if n not in outputs}
    also = {n for table in (d.parameters, d.inputs) for v in table.values() for n in v.also}
    taken = {*outputs, *states, *d.inputs, *d.parameters, *also}
    others = {n: v for n, v in d.variables.items() if n not in taken and v.recordable}
    tables = (d.inputs, outputs, d.parameters, states, others)
    return FrozenMap({g: FrozenMap(t) for g, t in zip(GROUPS, tables, strict=True)})


def tested_capabilities(model: FmuModel, known: Capabilities | None = None) -> Capabilities:
    """Return the capabilities of an FMU with the results of short test runs, or the error of those that fail."""
    described = known or read_capabilities(model.fmu.path)
    results = {}
    for subject, test in {"two short runs": _two_runs, "derivatives at the start": _derivatives}.items():
        try:
            results[subject] = test(model, described)
        except HvdcIdentError as e:
            results[subject] = f"failed: {e.what}" + (f" ({e.got})" if e.got else "")
    results |= {subject: str(model.pool.learned.get(key, "")) for subject, key in LEARNED.items()}
    return replace(described, found=FrozenMap({k: v for k, v in results.items() if v}))


def _two_runs(model: FmuModel, described: Capabilities) -> str:
    """Return in words whether a second run equals the first."""
    from hvdc_ident.data import experiment
    from hvdc_ident.fmu.evaluate import simulate_without_effects
    from hvdc_ident.simulate import Tolerance

    if not model.outputs:
        return ""
    start = described.experiment.get("start", 0.0)
    span = SHORT_RUN * max(described.experiment.get("stop", start + 1.0) - start, 0.0) or SHORT_RUN
    short = experiment("short", np.linspace(start, start + span, 11), {})

    def run() -> Array:
        names = tuple(model.outputs)
        return simulate_without_effects(model, short, {}, (), names, Tolerance(), fresh=True).trajectory.values

    first, second = run(), run()
    relative = np.abs(second - first).max(axis=0) / np.maximum(np.abs(first).max(axis=0), 1e-300)
    names = [n for n, r in zip(model.outputs, relative.tolist(), strict=True) if r > 0.0]
    length = f"{span:g} s from {start:g} s"
    if not names:
        return f"equal, {length}"
    return f"differ by up to {relative.max():.2g} of their size in {', '.join(names[:3])}, {length}"


def _derivatives(model: FmuModel, _: Capabilities) -> str:
    """Return in words which derivatives the FMU computes itself, and whether these agree with differences."""
    from hvdc_ident.fmu.evaluate import at_point, smooth_inputs

    if not model.has_equations or not model.states:
        return ""
    if not model.fmu.directional:
        return "differences: directional ones are not offered"
    real = [n for n, v in model.fmu.parameters.items() if not v.whole]
    point = at_point(model, {}, None, tuple(model.outputs), real)
    columns = [*model.states, *smooth_inputs(model), *real]
    wrong = [n for n, directional in zip(columns, point.directional.tolist(), strict=True) if not directional]
    if not wrong:
        return f"directional ones agree with differences, for all {len(columns)} states, inputs and parameters"
    some = ", ".join(wrong[:4]) + (" ..." if len(wrong) > 4 else "")
    return f"directional ones are refused or differ from differences for {len(wrong)} of {len(columns)}: {some}"
