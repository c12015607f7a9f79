"""The first lines of the page: what was asked and what came out, in five sentences."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.html import number, share, text
from hvdc_ident.report.results import Results, Section
from hvdc_ident.text import listed


def _render(results: Results) -> str:
    fit = results.get("fit")
    lines = [_asked(results, fit), _estimated(results, fit), _closer(fit), _adequate(fit), _missing(results)]
    return "".join(f"<p>{line}</p>" for line in [*lines, *_warnings(results)] if line)


def _asked(results: Results, fit: dict[str, Any]) -> str:
    experiments = results.experiments
    held_out = sum(1 for e in experiments.values() if e.get("role") == "holdout")
    kept = f", {held_out} of them held out" if held_out else ""
    against = f" against {_count(len(experiments), 'experiment')}{kept}" if experiments else ""
    return f"Model <strong>{text(results.heading.get('model', ''))}</strong>{against}."


def _estimated(results: Results, fit: dict[str, Any]) -> str:
    """Sentence on the parameters that were estimated and the one that moved most; without a fit, on those that could be."""
    told = results.get("identifiability")
    candidates = list(fit.get("candidates") or told.get("parameters") or {})
    fitted = [str(n) for n in fit.get("fitted") or ([] if fit else told.get("identifiable") or [])]
    held = [n for n in candidates if n not in fitted]
    rest = f"; {text(listed(held))} {'is' if len(held) == 1 else 'are'} held" if held else ""
    if not fit:
        return f"These data tell {text(listed(fitted)) if fitted else 'no candidate'}{rest}." if candidates else ""
    if not fitted or fit.get("status") == "failed":
        return ""
    moved = {}
    for name in fitted:
        given, value = (fit["candidates"].get(name) or {}).get("given"), (fit.get("values") or {}).get(name)
        if given and value is not None:
            moved[name] = (abs(value / given - 1.0), share(value, given), number(value))
    most = max(moved, key=lambda n: moved[n][0], default=None)
    how = f"; {text(most)} differs most from what was given, by {moved[most][1]}: {moved[most][2]}" if most else ""
    unit = str((fit["candidates"].get(most) or {}).get("unit", "")) if most else ""
    return (
        f"{_count(len(fitted), 'parameter')} estimated: {text(listed(fitted))}{how} {text(unit)}".rstrip() + f"{rest}."
    )


def _closer(fit: dict[str, Any]) -> str:
    ratios = _ratios(fit) if fit.get("fitted") and fit.get("status") != "failed" else []
    if not ratios:
        return ""
    low, high = number(100 * min(ratios), 3), number(100 * max(ratios), 3)
    return f"After the fit the RMSE of each signal is {low if low == high else f'{low} to {high}'} % of what it is with the given values."


def _adequate(fit: dict[str, Any]) -> str:
    chi = fit.get("chi2_per_dof")
    if chi is None or any("misfit" in str(s) for s in (fit.get("noise_source") or {}).values()):
        return ""
    verdict = (fit.get("adequacy") or {}).get("verdict", "fits" if chi < 1.5 else "does-not-fit")
    left = {
        "does-not-fit": "more than noise is left over, so the model lacks something",
        "noise-understated": "the residual is white and above the noise told, which may be too small",
        "noise-overstated": "the noise told is larger than what the residual shows",
    }.get(verdict, "the model explains the recordings down to their noise")
    return f"χ² per degree of freedom is {number(chi, 3)}: {left}."


def _missing(results: Results) -> str:
    """The diagnosis: what is missing and where, what else it may be, and what the gap did."""
    found = results.get("discrepancy")
    if not found.get("verdict"):
        return ""
    effects = found.get("effects") or []
    if not effects:
        return f"Diagnosis: {text(str(found.get('text', '')).rstrip('.'))}."
    what = "; and ".join(text(str(e["text"]).rstrip(".")) for e in effects)
    rivals = max((len(group) - 1 for group in found.get("ambiguity") or []), default=0)
    others = f", or one of {rivals} others" if rivals > 1 else ", or another effect" if rivals else ""
    if not rivals and found["verdict"] == "ambiguous":
        others = f", or something that looks like {'it' if len(effects) == 1 else 'them'}"
    return f"What the model lacks: {what}{others}{_shrunk(found.get('gap') or {})}."


def _shrunk(gap: dict[str, Any]) -> str:
    """Clause on the residual before and after the addition, on held-out data where there are any."""
    pooled = gap.get("pooled") or {}
    for part, where in (("holdout", "held-out"), ("fit", "fitted")):
        was, now = ((pooled.get(m) or {}).get(part) for m in ("refitted", "augmented"))
        if was and now:
            return f"; with it the {where} residual goes from {number(was, 3)} to {number(now, 3)} times the noise"
    return ""


def _warnings(results: Results) -> list[str]:
    """Stages that failed, and results of an earlier state of the study."""
    failed = {n: s["failed"] for n, s in (results.get("run").get("stages") or {}).items() if s.get("failed")}
    lines = [f"<strong>{text(n)} failed</strong>: {text(str(why).rstrip('.'))}." for n, why in failed.items()]
    for name, data in results.stages.items():
        if data.get("sources") != results.heading.get("sources"):
            lines.append(f"{text(name)}.json comes from an earlier state of the study: run it again.")
    return lines


def _count(n: int, word: str) -> str:
    return f"{n} {word}{'' if n == 1 else 's'}"


def _ratios(fit: dict[str, Any]) -> list[float]:
    """RMSE after over before for each output and experiment that the fit used and that moved at all."""
    before, found = fit.get("rmse_given") or {}, []
    for output, line in (fit.get("rmse") or {}).items():
        for name, after in line.items():
            first = (before.get(output) or {}).get(name)
            if first and after is not None:
                found.append(after / first)
    return found


SECTION = Section(order=10, title="Summary", render=_render)
