"""The JSON Schemas accept what the readers accept, and refuse the keys that they refuse."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from collections.abc import Iterator
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from hvdc_ident.errors import InputError
from hvdc_ident.model.card import parse_card, write_card
from hvdc_ident.model.check import SECTIONS
from hvdc_ident.models import load_model, shipped_models
from hvdc_ident.study import json_schema
from hvdc_ident.study.examples import write_demo, write_starter
from hvdc_ident.study.parse import checked

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"^```toml\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def _shipped() -> tuple[dict[str, str], dict[str, str]]:
    """The texts of all studies and of all cards that are shipped: files, and whole ones in the pages' blocks."""
    texts = {
        str(p.relative_to(ROOT)): p.read_text("utf-8")
        for p in sorted((ROOT / "studies").rglob("*.toml"))
        if "-results" not in str(p)
    }
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        blocks = [b for b in BLOCK.findall(page.read_text("utf-8")) if b.startswith("schema = 1")]
        texts |= {f"{page.name} block {i}": b for i, b in enumerate(blocks)}
    texts |= {f"shipped model {n}": write_card(load_model(n)) for n in shipped_models()}  # type: ignore[arg-type]
    for room in ("shelf", "models"):
        texts |= {f"{room}/{p.name}": p.read_text("utf-8") for p in sorted((ROOT / "hvdc_ident" / room).glob("*.toml"))}
    studies = {n: t for n, t in texts.items() if "source" in tomllib.loads(t).get("model", {})}
    return studies, {n: t for n, t in texts.items() if n not in studies}


STUDIES, CARDS = _shipped()


VALIDATORS = {n: jsonschema.Draft202012Validator(json.loads(json_schema.schema_text(n))) for n in json_schema.FILES}


def _accepts(name: str, table: dict[str, Any]) -> bool:
    return VALIDATORS[name].is_valid(table)


@pytest.mark.parametrize("name", json_schema.FILES)
def test_schemas_are_schemas_that_describe_every_key(name: str) -> None:
    schema = VALIDATORS[name].schema
    jsonschema.Draft202012Validator.check_schema(schema)
    for table in (schema, *schema["$defs"].values()):
        assert all(p["description"].count("Example: ") == 1 for p in table["properties"].values())


@pytest.mark.parametrize("section", SECTIONS)
def test_a_card_has_the_fields_of_the_model_that_it_becomes(section: str) -> None:
    (keys,) = (k for path, k in json_schema.reference("model-card").items() if path == f"{section}.NAME")
    kind = SECTIONS[section][0]
    assert {k.name: k.required for k in keys} == {f.name: f.default is MISSING for f in fields(kind)}
    stated = {k.name: json.loads(k.default) for k in keys if k.default}
    assert stated == {f.name: f.default for f in fields(kind) if f.name in stated}


@pytest.mark.parametrize("kind", json_schema.FILES)
def test_examples_of_keys_are_toml_that_names_the_key(kind: str) -> None:
    for table, keys in json_schema.reference(kind).items():
        for key in keys:
            assert key.text.endswith("."), (table, key)
            tomllib.loads(key.example)
            assert re.search(rf"\b{re.escape(key.name)}\b", key.example) or table in ("signals.NAME", "outputs.NAME"), (
                key
            )


@pytest.mark.parametrize("name", STUDIES)
def test_studies_are_accepted_and_misspelt_keys_refused_as_by_the_reader(name: str) -> None:
    study = tomllib.loads(STUDIES[name])
    assert _accepts("study", study)
    for wrong in _misspelt(study):
        try:
            checked(copy.deepcopy(wrong), "study.toml")
            read = True
        except InputError:
            read = False
        assert _accepts("study", wrong) is read, wrong


def test_new_studies_are_accepted_and_name_their_schema(tmp_path: Path) -> None:
    for path in (write_starter(tmp_path / "new"), write_demo(tmp_path / "demo")):
        assert _accepts("study", tomllib.loads(path.read_text("utf-8")))
    first = (tmp_path / "new" / "study.toml").read_text("utf-8").splitlines()[0]
    named = tmp_path / "new" / first.removeprefix("#:schema ")
    assert named.read_text("utf-8") == json_schema.schema_text("study")
    assert (named.parent / "model-card.json").read_text("utf-8") == json_schema.schema_text("model-card")


@pytest.mark.parametrize("name", CARDS)
def test_cards_are_accepted_and_misspelt_keys_refused(name: str) -> None:
    card = tomllib.loads(CARDS[name])
    parse_card(CARDS[name])
    assert _accepts("model-card", card)
    for key in card:
        assert not _accepts("model-card", {f"{k}x" if k == key else k: v for k, v in card.items()})
    for section in (*SECTIONS, "components", "connections"):
        for item, keys in card.get(section, {}).items():
            for key in keys if isinstance(keys, dict) else ():
                wrong = copy.deepcopy(card)
                wrong[section][item][f"{key}x"] = wrong[section][item].pop(key)
                assert not _accepts("model-card", wrong), (section, item, key)


NESTED = """
schema = 1
[model]
source = "plant.toml"
[model.values]
gen.H = 3.0
[parameters]
net.R = {min = 0.0, max = 0.1}
gen = {Xd = {start = 1.8}, avr = {K = {given = 200, prior = {mean = 200, std = 20}}}}
[[experiment]]
name = "step"
data = "step.csv"
inputs = {gen = {u = "Vf"}}
outputs = {gen = {P = "MW", Q = "MVAr"}}
noise = {gen = {P = 0.1, Q = {column = "sd"}}}
columns = {gen = {P = {unit = "MW", base = 100}}}
instrument = {gen = {P = {delay = 0.001}}}
interpolation = {gen = {u = "linear"}}
[linearize]
scale = {gen = {u = 0.02}}
[diagnose]
tolerance = {gen = {P = 0.5}}
"""


def test_names_of_components_may_be_nested_wherever_a_table_is_by_name() -> None:
    table = tomllib.loads(NESTED)
    assert _accepts("study", table)
    file = checked(copy.deepcopy(table), "study.toml")
    assert list(file.parameters) == ["net.R", "gen.Xd", "gen.avr.K"] and file.parameters["gen.avr.K"].prior is not None
    (e,) = file.experiment
    assert dict(e.inputs) == {"gen.u": "Vf"} and dict(e.outputs) == {"gen.P": "MW", "gen.Q": "MVAr"}
    assert e.noise["gen.P"] == 0.1 and e.noise["gen.Q"].column == "sd"  # type: ignore[union-attr]
    assert e.columns["gen.P"].base == 100 and e.instrument["gen.P"].delay == 0.001
    assert e.interpolation == {"gen.u": "linear"} and file.model.values == {"gen.H": 3.0}
    assert file.linearize is not None and file.linearize.scale == {"gen.u": 0.02}
    assert file.diagnose is not None and file.diagnose.tolerance == {"gen.P": 0.5}
    for wrong in ("gen = {Xd = {strt = 1.8}}", "gen = {Xd = 1.8}", "gen = {avr = {K = {prior = {mean = 200}}}}"):
        study = tomllib.loads(f'schema = 1\n[model]\nsource = "plant.toml"\n[parameters]\n{wrong}\n')
        assert not _accepts("study", study)
        with pytest.raises(InputError):
            checked(study, "study.toml")


@pytest.mark.parametrize("line", ["K = {mn = 5}", "gen.K = {mn = 5}", "gen = {avr = {K = {start = 1, mn = 5}}}"])
def test_an_editor_is_told_which_key_is_unknown_and_which_there_are(line: str) -> None:
    study = tomllib.loads(f'schema = 1\n[model]\nsource = "plant.toml"\n[parameters]\n{line}\n')
    (error,) = VALIDATORS["study"].iter_errors(study)
    assert "'mn' was unexpected" in error.message
    ((_, item),) = VALIDATORS["study"].schema["properties"]["parameters"]["patternProperties"].items()
    assert item["properties"] == VALIDATORS["study"].schema["$defs"]["ParameterTable"]["properties"]


def test_a_component_needs_no_more_than_its_source() -> None:
    card = tomllib.loads('schema = 1\nname = "plant"\n[components.bus]\nsource = "infinite-bus"\n')
    assert _accepts("model-card", card)
    del card["components"]["bus"]["source"]
    assert not _accepts("model-card", card)


@pytest.mark.parametrize(
    "line",
    [
        '[fit]\nstarts = "4"',
        "[fit]\nguard = -1",
        '[[sweep]]\nparameter = "K"\nsampling = "grod"',
        "[diagnose]\nmost = 0",
    ],
)
def test_values_that_the_reader_refuses_are_refused(line: str) -> None:
    study = tomllib.loads(f'schema = 1\n[model]\nsource = "vsc-hvdc-link"\n{line}\n')
    with pytest.raises(InputError):
        checked(copy.deepcopy(study), "study.toml")
    assert not _accepts("study", study)


def test_the_date_of_a_letter_may_be_a_date_of_toml() -> None:
    study = tomllib.loads('schema = 1\n[model]\nsource = "m.toml"\n[letter]\ndate = 2026-11-25\n')
    letter = checked(study, "study.toml").letter
    assert letter is not None and letter.date == "2026-11-25"


def _misspelt(table: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The table once with each of its keys, at any depth, misspelt."""
    for key, value in table.items():
        yield {f"{k}x" if k == key else k: v for k, v in table.items()}
        if isinstance(value, dict):
            yield from ({**table, key: inner} for inner in _misspelt(value))
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            yield from ({**table, key: [inner, *value[1:]]} for inner in _misspelt(value[0]))
