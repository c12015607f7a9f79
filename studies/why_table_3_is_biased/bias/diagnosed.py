"""The diagnoses without hints, and the gains and Fig. 8 with the inserted effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from common import diagnosing, paper

from hvdc_ident.data import Experiment
from hvdc_ident.discrepancy import DiagnosisOptions, diagnose
from hvdc_ident.effects import apply_effects
from hvdc_ident.expression import parse
from hvdc_ident.fit import FitParameter, Problem, fit
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, Output
from hvdc_ident.models import load_model
from hvdc_ident.simulate import ModelSimulator
from hvdc_ident.study.examples import Campaign, Noise, recorded

NOISE = 5e-4
"""Standard deviation of every record, pu: a twentieth of a per cent of the rating; far below the paper's own residuals."""
FITTED = ("p-01-step", "p-02-ramp", "q-01-step", "vdc-01-step", "vdc-02-ramp")
HELD_OUT = ("p-03-step", "q-03-step", "vdc-03-step")
SAMPLE = 2e-3  # s
LOUDER = (2e-3,)
"""Other standard deviations: of the size of the paper's residuals, 2e-4 to 5e-3."""
OPTIONS = DiagnosisOptions(fallback=False)
"""As by default, but nothing outside the catalogue."""


@dataclass(frozen=True)
class Asked:
    """The recorded outputs and the options of a diagnosis."""

    outputs: tuple[str, ...]
    options: DiagnosisOptions = OPTIONS


MORE = (*paper.OUTPUTS, "Vdc1", "P2", "Q1", "Ir1", "Ir2")
TOLD_NOTHING = {"the paper's signals": Asked(paper.OUTPUTS), "P, Q, Vdc and currents too": Asked(MORE)}
FINER = {
    # A gap of a twentieth of the noise matters here, for it is the gains that are asked for.
    "the same, smaller gap relevant": Asked(MORE, replace(OPTIONS, holdout_share=0.05))
}
ASKED = TOLD_NOTHING | FINER
FREE = ("KIP", "KPVDC", "KIVDC", "KIQ")
AT = tuple(float(k) for k in range(550, 951, 25))


def link() -> Model:
    """Return the plain link with its currents as further outputs."""
    plain = load_model(paper.LINK)
    currents = {n: Output(parse(n), "pu") for n in ("Ir1", "Ir2")}
    return replace(plain, outputs=FrozenMap({**plain.outputs, **currents}))


def experiments(outputs: Sequence[str], noise: float = NOISE) -> tuple[Experiment, ...]:
    """Return five experiments to fit and three held out, from the average-value link, with white noise."""
    campaign = Campaign(source=paper.REFERENCE, count=3, holdout=1, sample=SAMPLE, at_rest=True, outputs=tuple(outputs),
                        noise=Noise(noise))  # fmt: skip
    return tuple(e for e in recorded(campaign) if e.name in (*FITTED, *HELD_OUT))


def unknowns() -> tuple[FitParameter, ...]:
    """Return the gains, which start at Table I's, the vendor's values."""
    return tuple(FitParameter(n, paper.TABLE_1[n], paper.TABLE_1[n] / 4, 3 * paper.TABLE_1[n]) for n in FREE)


def diagnosis(name: str, *, noise: float = NOISE, executor: Any = None) -> dict[str, Any]:
    """Return the diagnosis of one of ASKED, at every insertion point."""
    asked = ASKED[name]
    found = diagnose(
        link(),
        experiments(asked.outputs, noise),
        unknowns(),
        options=asked.options,
        executor=executor,
        progress=diagnosing.on_stderr(name),
    )
    first = [c for c in found.candidates if c.round == 1 and c.delta_bic is not None]
    told = diagnosing.told(found)
    told["first round"] = [
        {"effect": c.effect, "at": list(c.at), "from": c.source, "parameters": dict(c.size), "delta_bic": c.delta_bic,
         "holdout": c.holdout_rmse}
        for c in sorted(first, key=lambda c: -(c.delta_bic or 0.0))[:12]
    ]  # fmt: skip
    return told


def put_in(told: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the named effects, or else the best of the first round, with sizes and the gains refitted with them."""
    if told["effects"]:
        return {"effects": sized(told)} | {k: dict(told[k]) for k in ("refitted", "augmented")}
    best, plain = told["first round"][0], link()
    brought = {"from": best["from"]} if best["from"] else {}
    model = apply_effects(
        plain, [{"effect": best["effect"], "at": best["at"], "parameters": best["parameters"], **brought}]
    )
    own = dict(zip((n for n in model.parameters if n not in plain.parameters), best["parameters"], strict=True))
    sizes = tuple(FitParameter(n, v, v / 5, 5 * v) for n, q in own.items() if (v := best["parameters"][q]))
    result = fit(Problem(ModelSimulator(model), experiments(ASKED[name].outputs), (*unknowns(), *sizes)), starts=1)
    if result.status not in ("converged", "at-bound"):
        raise RuntimeError(f"the fit with {best['effect']} ended without an estimate: {result.message}")
    found = dict(best["parameters"]) | {own[f.name]: result.values[f.name] for f in sizes}
    return {
        "effects": [{"effect": best["effect"], "at": best["at"], "from": best["from"], "parameters": found}],
        "refitted": dict(told["refitted"]),
        "augmented": {n: result.values[n] for n in FREE},
    }


def sized(told: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the effects of a diagnosis with only the values of their parameters."""
    return [{**e, "parameters": {n: s["value"] for n, s in e["parameters"].items()}} for e in told["effects"]]


def figure_8(told: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the RMSE of Irorder1 over KIVDC in the paper's step, plain and augmented link, each with its fitted KPVDC."""
    step = paper.step("Vdc", paper.REFERENCE, ["Irorder1"])
    lines = {
        "plain link": (load_model(paper.LINK), told["refitted"]),
        "augmented link": (diagnosing.augmented(load_model(paper.LINK), told["effects"]), told["augmented"]),
    }
    return {
        name: {f"{k:g}": paper.rmse(step, {"KPVDC": gains["KPVDC"], "KIVDC": k}, model)["Irorder1"] for k in AT}
        for name, (model, gains) in lines.items()
    }


def share_gone(told: Mapping[str, Any]) -> dict[str, float]:
    """Return by gain the share of the plain link's bias that the inserted effects remove, 1 for all of it."""
    return {
        n: 1.0 - abs(told["augmented"][n] - paper.TABLE_1[n]) / abs(told["refitted"][n] - paper.TABLE_1[n])
        for n in FREE
    }
