"""Judgements as a stage's JSON has them, made of errors that a test states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hvdc_ident.fit.judgement import Judgement, SignalJudgement
from hvdc_ident.immutable import FrozenMap

Table = Mapping[str, Mapping[str, float]]
PROFILE = {
    "name": "steps",
    "version": "1",
    "title": "steps",
    "source": "IEC 61400-27-2:2020 (windows)",
    "notes": "",
    "unit": "pu",
}
NO_WINDOW = {"event": None, "within": None, "reason": "no event: no input moves and none is given"}


def judgement(
    sets: Mapping[str, Table],
    noise: Mapping[str, float | None],
    windows: Mapping[str, Mapping[str, Any]] | None = None,
    tolerance: Mapping[str, float] | None = None,
    *,
    named: bool = False,
) -> dict[str, Any]:
    """The judgement of RMSE by set of values, output and experiment; noise, windows and tolerance by output."""
    found, limit, seen = {}, tolerance or {}, windows or {}
    for name, table in sets.items():
        signals = {
            o: FrozenMap({e: _signal(v, noise.get(o), limit.get(o), seen.get(o, NO_WINDOW)) for e, v in line.items()})
            for o, line in table.items()
        }
        limited = any(s.follows["windows"] is not None for line in signals.values() for s in line.values())
        by = "tolerance" if tolerance else "windows" if named and limited else "noise"
        found[name] = Judgement(by, FrozenMap(signals)).to_dict()
    return {"tolerance": dict(tolerance or {}), "profile": {**PROFILE, "named": named}, "sets": found}


def _signal(rmse: float, noise: float | None, tolerance: float | None, windows: Mapping[str, Any]) -> SignalJudgement:
    on_noise = None if noise is None else rmse**2 <= 2.0 * noise**2
    kept = None if tolerance is None else rmse <= tolerance
    follows = FrozenMap({"noise": on_noise, "tolerance": kept, "windows": windows["within"]})
    return SignalJudgement(rmse, 3.0 * rmse, noise, tolerance, windows, follows)
