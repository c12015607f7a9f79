"""What to do next, as a value: results carry it, and each view says it in the words of the place where it is read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Door = Literal["shell", "python", "page"]
"""Places where a sentence is read: each has its own name for a thing to do."""
NextKind = Literal[
    "diagnose",
    "separate",
    "letter",
    "narrow",
    "export",
    "identify",
    "fit",
    "force",
    "given",
    "raise-noise",
    "lower-noise",
]
TO_DO: dict[str, dict[Door, str]] = {
    "diagnose": {"shell": "`hvdc-ident diagnose STUDY`", "python": "`hi.diagnose(...)`", "page": "the stage diagnose"},
    "identify": {"shell": "`hvdc-ident identify STUDY`", "python": "`hi.identify(...)`", "page": "the stage identify"},
    "fit": {"shell": "`hvdc-ident fit STUDY`", "python": "`values=hi.fit(...)`", "page": "the stage fit"},
    "given": {"shell": "`--values given`", "python": '`values="given"`', "page": "the given values"},
    "force": {"shell": "`--force NAME`", "python": '`force=["NAME"]`', "page": "a fit with `--force NAME`"},
    "letter": {"shell": "`hvdc-ident letter STUDY`", "python": "`hvdc-ident letter`", "page": "the button Letter"},
    "export": {
        "shell": "`hvdc-ident export STUDY --to FILE`",
        "python": "`hi.export(...)`",
        "page": "a button below Take away",
    },
}
PURPOSES = {
    "diagnose": "looks for what the model lacks",
    "identify": "says why of each, and what to measure next",
    "fit": "estimates what the recordings determine",
    "given": "takes those that the model came with",
    "force": "fits one all the same",
    "letter": "writes one page on this for the model's owner",
    "export": "writes the model with the values that count (.fmu, .mo, .toml)",
}


@dataclass(frozen=True)
class NextStep:
    """Step to take next.

    kind: run the diagnosis; record what tells likely effects apart ("separate"); write the letter to the model's owner; record what
    narrows the intervals; export the values; see why nothing is estimated; fit; fit a parameter against its verdict; take the given
    values; state a larger noise, or a smaller one. text: of a recording, what to record; of a noise, its standard deviations by output.
    """

    kind: NextKind
    text: str = ""


def next_phrase(step: NextStep, door: Door = "shell") -> str:
    """Return what to do, as a clause."""
    if step.kind == "raise-noise":
        return f"state noise = {{{step.text}}} if the instrument may be as noisy as that"
    if step.kind == "lower-noise":
        return (
            f"state noise = {{{step.text}}}, or leave it out to have it estimated: the intervals are too wide as they are"
        )
    return f"{TO_DO[step.kind][door]} {PURPOSES[step.kind]}"


def next_sentence(step: NextStep, door: Door = "shell") -> str:
    """Return what to do, as a sentence for a terminal, a notebook or the workbench."""
    if step.kind in ("separate", "narrow"):
        return f"Measure next: {step.text}"
    return f"Next: {next_phrase(step, door)}."


def next_phrases(steps: Iterable[NextStep], door: Door = "shell") -> str:
    """Return several things to try, the first thing first, in one text."""
    return "; else ".join(next_phrase(step, door) for step in steps)
