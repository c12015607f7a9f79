"""Archives and descriptions that are refused before anything of them is unpacked or run."""

from __future__ import annotations

import re
import stat
import zipfile
from itertools import pairwise

import pytest
from fmpy import platform, platform_tuple, sharedLibraryExtension
from hypothesis import given, settings
from hypothesis import strategies as st

from hvdc_ident import load_model
from hvdc_ident.errors import InputError, ModelError
from hvdc_ident.fmu import archive as checks
from hvdc_ident.fmu import compile_fmu, read_capabilities, read_description
from hvdc_ident.fmu import description as read
from tests.fmu.c_fmu import CModel, Var, description

PLAIN = CModel(
    "lag",
    "",
    (
        Var("x", 0),
        Var("der(x)", 1, more=(("derivative", "x"),)),
        Var("T", 2, "parameter", "tunable", (("start", "0.1"),)),
        Var("u", 3, "input", more=(("start", "0"),)),
        Var("y", 0, "output"),
    ),
)


def binary(version=2, name="lag"):
    folder = platform if version == 2 else platform_tuple
    return f"binaries/{folder}/{name}{sharedLibraryExtension}"


def written(path, text=None, *, version=2, entries=(), name="lag"):
    """An FMU whose binary is no library; entries: further (ZipInfo or name, bytes)."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as z:
        if text is not False:
            z.writestr("modelDescription.xml", text if text is not None else description(PLAIN, version))
        z.writestr(binary(version, name), b"no library")
        for entry, content in entries:
            z.writestr(entry, content)
    return path


def link():
    entry = zipfile.ZipInfo("resources/link")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    return entry


def pipe():
    entry = zipfile.ZipInfo("resources/pipe")
    entry.external_attr = (stat.S_IFIFO | 0o600) << 16
    return entry


def device():
    entry = zipfile.ZipInfo("resources/device")
    entry.external_attr = (stat.S_IFCHR | 0o600) << 16
    return entry


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("../escape.txt", "leads out of it"),
        ("resources/../../escape.txt", "leads out of it"),
        ("/etc/escape", "leads out of it"),
        ("C:/escape", "leads out of it"),
        ("resources\\..\\..\\escape", "leads out of it"),
        (link(), "is a link"),
        (pipe(), "neither a file nor a folder"),
        (device(), "neither a file nor a folder"),
        ("..", "leads out of it"),
        ("../", "leads out of it"),
        ("./../canary", "leads out of it"),
        ("resources/x/../../../../canary", "leads out of it"),
        ("//host/share/canary", "leads out of it"),
        ("\\\\host\\share\\canary", "leads out of it"),
        ("..\\canary", "leads out of it"),
        ("c:canary", "leads out of it"),
    ],
)
def test_entries_that_are_refused(tmp_path, entry, message):
    folder = tmp_path / "here"
    folder.mkdir()
    path = written(folder / "a.fmu", entries=[(entry, b"x")])
    for place in (tmp_path, folder):
        (place / "canary").write_text("sings")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ModelError, match=message):
        load_model(path)
    assert sorted(tmp_path.rglob("*")) == before
    assert all((place / "canary").read_text() == "sings" for place in (tmp_path, folder))


@pytest.mark.parametrize(
    "entries",
    [
        [("resources", b"a file"), ("resources/a", b"below a file")],
        [("resources/" + "n" * 300, b"x")],
        [("n" * 300 + "/a", b"x")],
    ],
)
def test_entries_that_cannot_be_unpacked(tmp_path, entries):
    path, folder = written(tmp_path / "a.fmu", entries=entries), tmp_path / "unpacked"
    checks.check_archive(path)
    with pytest.raises(ModelError, match="cannot be unpacked") as caught:
        checks.unpack(path, folder)
    assert str(folder) not in str(caught.value) and len(str(caught.value)) < 400


def test_sizes_that_are_refused(tmp_path, monkeypatch):
    bomb = written(tmp_path / "bomb.fmu", entries=[("resources/zeros", bytes(8 * 2**20))])
    with pytest.raises(ModelError, match="zip bomb"):
        load_model(bomb)
    monkeypatch.setattr(checks, "MOST_BYTES", 1000)
    with pytest.raises(ModelError, match="unpacks to too much"):
        load_model(written(tmp_path / "big.fmu"))
    monkeypatch.undo()
    many = written(tmp_path / "many.fmu", entries=[(f"resources/{k}", b"") for k in range(checks.MOST_ENTRIES)])
    with pytest.raises(ModelError, match="too many files"):
        load_model(many)
    assert (checks.MOST_BYTES, checks.MOST_RATIO, checks.MOST_ENTRIES) == (2**30, 200, 10_000)


def test_the_xml_is_well_formed_and_has_no_doctype(tmp_path):
    bomb = '<?xml version="1.0"?><!DOCTYPE b [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]><fmiModelDescription>&b;</fmiModelDescription>'
    outer = '<?xml version="1.0"?><!DOCTYPE x SYSTEM "file:///etc/passwd"><fmiModelDescription/>'
    for text in (bomb, outer, bomb.encode("utf-16").decode("utf-16").encode("utf-16")):
        with pytest.raises(ModelError, match="DOCTYPE"):
            load_model(written(tmp_path / "a.fmu", text))
    with pytest.raises(ModelError, match="not well-formed"):
        load_model(written(tmp_path / "b.fmu", "<fmiModelDescription>"))
    sources = [("sources/lag.c", "int lag;"), ("sources/buildDescription.xml", bomb)]
    with pytest.raises(ModelError, match=r"buildDescription.*DOCTYPE"):
        compile_fmu(written(tmp_path / "c.fmu", version=3, entries=sources))


HEAD = '<?xml version="1.0"?>'
REFUSED = {
    "empty": "",
    "no xml": "PK",
    "laughs": HEAD
    + '<!DOCTYPE l [<!ENTITY a "ha">'
    + "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in pairwise("abcdefghij"))
    + "]><fmiModelDescription>&j;</fmiModelDescription>",
    "parameter entity": HEAD + '<!DOCTYPE x [<!ENTITY % p SYSTEM "file:///etc/passwd"> %p;]><fmiModelDescription/>',
    "outer doctype": HEAD + '<!DOCTYPE x PUBLIC "-//x" "http://127.0.0.1:9/x.dtd"><fmiModelDescription/>',
    "entity without doctype": HEAD + "<fmiModelDescription>&a;</fmiModelDescription>",
    "nul": HEAD + "<fmiModelDescription>\0</fmiModelDescription>",
    "two roots": HEAD + "<fmiModelDescription/><fmiModelDescription/>",
    "attribute twice": HEAD + '<fmiModelDescription fmiVersion="2.0" fmiVersion="3.0"/>',
    "unknown encoding": '<?xml version="1.0" encoding="x-none"?><fmiModelDescription/>',
    "false utf-8": HEAD.encode() + b"<fmiModelDescription modelName='\xff\xfe'/>",
    "never closed": HEAD + "<a>" * 200_000,
    "deep": HEAD + "<a>" * 200_000 + "</a>" * 200_000,
    "another root": HEAD + '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="file:///etc/passwd"/>',
}


@pytest.mark.parametrize("name", REFUSED)
def test_hostile_xml_is_refused(tmp_path, name):
    path = written(tmp_path / "a.fmu", REFUSED[name])
    (tmp_path / "canary").write_text("sings")
    with pytest.raises(ModelError) as caught:
        load_model(path)
    assert "root:" not in str(caught.value) and len(str(caught.value)) < 1000
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.fmu", "canary"]


@pytest.mark.parametrize("name", ["../lag", "a/b", "", "..", ".lag", "-lag", "..\\lag"])
def test_a_model_identifier_that_is_no_name_of_a_file_is_refused(tmp_path, name):
    text = description(PLAIN, 2).replace('modelIdentifier="lag"', f'modelIdentifier="{name}"')
    with pytest.raises(ModelError, match="model identifier"):
        load_model(written(tmp_path / "a.fmu", text))


@pytest.mark.parametrize("version", ["1.0", "2.1", "3.0-beta.2", "3.0-alpha.5", "4.0", ""])
def test_versions_that_are_not_read_are_named(tmp_path, version):
    """One before a release has other functions: its binary would be blamed on a token."""
    for text in (description(PLAIN, 2), description(PLAIN, 3)):
        text = re.sub(r'fmiVersion="[^"]*"', f'fmiVersion="{version}" generationTool="Maker 7"', text)
        path = written(tmp_path / "a.fmu", text, entries=[("sources/lag.c", "int lag;")])
        for work in (load_model, read_capabilities, compile_fmu):
            with pytest.raises(ModelError) as caught:
                work(path)
            assert "this version of FMI is not read" in str(caught.value) and "from Maker 7" in str(caught.value)
            assert (f"got FMI {version}" if version else "got no fmiVersion") in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["a.fmu"]


@pytest.mark.parametrize("version", ["3.0", "3.0.2", "3.1"])
def test_releases_of_fmi_3_are_read(tmp_path, version):
    text = description(PLAIN, 3).replace('fmiVersion="3.0"', f'fmiVersion="{version}"')
    assert read_description(written(tmp_path / "a.fmu", text, version=3)).version == 3


def test_a_missing_binary_is_told_before_the_variables_are_read(tmp_path, monkeypatch):
    """A hundred thousand of them take seconds."""
    path = tmp_path / "a.fmu"
    with zipfile.ZipFile(path, "w") as z:
        z.writestr("modelDescription.xml", description(PLAIN, 2))
    monkeypatch.setattr(read.Document, "variables", property(lambda _: pytest.fail("the variables were read")))
    with pytest.raises(ModelError, match="no binary for this machine"):
        load_model(path)


def test_files_that_are_no_fmu(tmp_path):
    with pytest.raises(ModelError, match="not there"):
        load_model(tmp_path / "none.fmu")
    (tmp_path / "text.fmu").write_text("no archive")
    with pytest.raises(ModelError, match="no zip archive"):
        load_model(tmp_path / "text.fmu")
    with pytest.raises(ModelError, match="no FMU"):
        load_model(written(tmp_path / "a.fmu", False))
    whole = written(tmp_path / "b.fmu").read_bytes()
    (tmp_path / "cut.fmu").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ModelError, match="no zip archive"):
        load_model(tmp_path / "cut.fmu")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_of_two_entries_of_one_name_the_last_counts_where_nothing_runs_or_reads_it(tmp_path):
    twice = [("extra/tool/a.txt", b"first"), ("extra/tool/a.txt", b"second"), (binary(), b"no library")]
    path = written(tmp_path / "a.fmu", entries=twice)
    assert list(load_model(path).outputs) == ["y"]
    checks.unpack(path, tmp_path / "there")
    assert (tmp_path / "there" / "extra" / "tool" / "a.txt").read_bytes() == b"second"
    other = description(PLAIN, 2).replace('name="T"', 'name="U"')
    for entries in (
        [(binary(), b"again")],
        [("resources/a", b"1"), ("resources/a", b"2")],
        [("resources/a", b"1"), ("resources\\a", b"2")],
        [("modelDescription.xml", other)],
    ):
        with pytest.raises(ModelError, match="two different files of one name"):
            load_model(written(tmp_path / "b.fmu", entries=entries))


def test_binaries_that_are_not_there(tmp_path):
    with pytest.raises(ModelError, match=r"no binary for this machine.*got binaries for win64"):
        path = tmp_path / "a.fmu"
        with zipfile.ZipFile(path, "w") as z:
            z.writestr("modelDescription.xml", description(PLAIN, 2))
            z.writestr("binaries/win64/lag.dll", b"")
        load_model(path)
    with pytest.raises(ModelError, match=r"got C sources only.*compile_fmu\('b.fmu'\)` compiles the C sources in it"):
        path = tmp_path / "b.fmu"
        with zipfile.ZipFile(path, "w") as z:
            z.writestr("modelDescription.xml", description(PLAIN, 2))
            z.writestr("sources/lag.c", b"")
        load_model(path)


def library(bits, machine):
    """The header of a shared library for Linux: ELF-32 or 64, and the machine by its number."""
    kind = bytes([{32: 1, 64: 2}[bits], 1, 1])
    return b"\x7fELF" + kind + bytes(9) + (3).to_bytes(2, "little") + machine.to_bytes(2, "little")


@pytest.mark.skipif(platform != "linux64", reason="the folders and libraries are those of Linux on x86_64")
@pytest.mark.parametrize(
    ("entries", "got"),
    [
        (
            [("binaries/linux64/", b""), ("binaries/win64/lag.dll", b"")],
            "an empty folder binaries/linux64; binaries for win64",
        ),
        ([("binaries/linux64/lagME.so", b"")], "lagME.so in that folder"),
        ([("binaries/linux32/lag.so", b"")], "binaries for linux32"),
        ([("binaries/linux64/lag.so", library(32, 3))], "x86 Linux, 32 bits"),
        ([("binaries/linux64/lag.so", library(64, 183))], "aarch64 Linux, 64 bits"),
        ([("binaries/linux64/lag.so", b"MZ" + bytes(62))], "got Windows"),
        ([], "no binaries at all"),
    ],
)
def test_what_is_in_the_place_of_the_binary(tmp_path, entries, got):
    path = tmp_path / "a.fmu"
    with zipfile.ZipFile(path, "w") as z:
        z.writestr("modelDescription.xml", description(PLAIN, 2))
        for name, content in entries:
            z.writestr(name, content)
    with pytest.raises(ModelError) as caught:
        load_model(path)
    assert got in str(caught.value) and "binaries/linux64/lag.so" in str(caught.value)


def test_what_fmi_has_and_this_has_not(tmp_path):
    three = description(PLAIN, 3)
    array = three.replace('start="0.1"/>', 'start="1 2"><Dimension start="2"/></Float64>').replace(
        '<Float64 name="T"', '<Float64 name="T"'
    )
    model = load_model(written(tmp_path / "a.fmu", array, version=3))
    assert list(model.parameters) == []  # it stays at its start
    with pytest.raises(ModelError, match=r"'T' is an array of 2, and arrays are not recorded.*scalar"):
        model.recording(["T"])
    array = three.replace('valueReference="0" causality="local" variability="continuous"/>',
        'valueReference="0" causality="local" variability="continuous"><Dimension start="3"/></Float64>', 1)  # fmt: skip
    with pytest.raises(
        ModelError, match=r"variable 'x': a state of the FMU is an array.*scalar states, got an array of 3"
    ):
        load_model(written(tmp_path / "a2.fmu", array, version=3))
    clock = three.replace(
        "</ModelVariables>",
        '<Clock name="tick" valueReference="77" causality="input" variability="discrete" intervalVariability="constant"/></ModelVariables>',
    )
    with pytest.raises(ModelError, match=r"'tick': the FMU has clocks"):
        load_model(written(tmp_path / "b.fmu", clock, version=3))
    one = description(PLAIN, 2).replace('fmiVersion="2.0"', 'fmiVersion="1.0"')
    with pytest.raises(ModelError, match=r"FMI 2\.0 or 3\.0|cannot be used|makes no sense"):
        load_model(written(tmp_path / "c.fmu", one))
    only = description(PLAIN, 2).replace(
        '<CoSimulation modelIdentifier="lag" canHandleVariableCommunicationStepSize="true"/>', ""
    )
    with pytest.raises(ModelError, match="does not offer"):
        load_model(written(tmp_path / "d.fmu", only), interface="co-simulation")
    stray = description(PLAIN, 2).replace(' derivative="1"', "")
    with pytest.raises(ModelError, match="of which state"):
        load_model(
            written(
                tmp_path / "e.fmu",
                stray.replace("<Derivatives></Derivatives>", '<Derivatives><Unknown index="2"/></Derivatives>'),
            )
        )


@pytest.mark.parametrize("version", [2, 3])
def test_what_is_read(tmp_path, version):
    found = read_description(written(tmp_path / "a.fmu", version=version))
    assert (found.version, found.interface, found.identifier) == (version, "model-exchange", "lag")
    assert list(found.states) == ["x"] and found.derivatives == (1,)
    assert found.parameters["T"].start == 0.1 and found.parameters["T"].variability == "tunable"
    assert list(found.outputs) == ["y"] and list(found.inputs) == ["u"]


STATE = '<Unknown index="2"/>'
TIME_CONSTANT = '<Real start="0.1"/>'
SENSELESS = [
    (2, 'valueReference="2"', 'valueReference="two"', r"variable 'T': .*a whole number as its value reference, got 'two'"),
    (2, 'valueReference="2"', "", r"variable 'T': .*a whole number as its value reference, got None"),
    (2, TIME_CONSTANT, "<Complex/>", "variable 'T': the type of the variable is not defined; got <ScalarVariable>"),
    (2, TIME_CONSTANT, '<Real declaredType="Seconds"/>', "the type of the variable is not defined; got Seconds"),
    (2, STATE, '<Unknown index="6"/>', "ModelStructure: .*a variable that is not there; got 6"),
    (2, STATE, '<Unknown index="0"/>', "ModelStructure: .*a variable that is not there; got 0"),
    (2, 'derivative="1"', 'derivative="x"', "ModelStructure: .*a whole number as a reference to a variable, got 'x'"),
    (2, STATE, STATE * 2, "the state 'x' has two derivatives"),
    (2, 'numberOfEventIndicators="0"', 'numberOfEventIndicators="-"', "a whole number as numberOfEventIndicators"),
    (3, 'Derivative valueReference="1"', 'Derivative valueReference="7"', "a variable that is not there; got 7"),
    (3, '<Float64 name="T"', '<Float16 name="T"', "variable 'T': the type of the variable is not defined; got <Float16>"),
    (3, 'start="0.1"/>', 'start="1"><Dimension valueReference="7"/></Float64>', "'T': .*whole number as a size of the array"),
]  # fmt: skip


@pytest.mark.parametrize(("version", "part", "other", "message"), SENSELESS)
def test_a_description_that_makes_no_sense_says_where(tmp_path, version, part, other, message):
    text = description(PLAIN, version)
    assert part in text
    with pytest.raises(ModelError, match=f"a.fmu, {message}" if message[0] == "v" else message):
        load_model(written(tmp_path / "a.fmu", text.replace(part, other), version=version))


def test_attributes_of_a_declared_type_count_where_a_variable_has_none(tmp_path):
    time = '<SimpleType name="Time" description="any"><Real unit="s" min="0" max="9" nominal="-2"/></SimpleType>'
    types = f"<TypeDefinitions>{time}</TypeDefinitions>"
    text = description(PLAIN, 2).replace("<ModelVariables>", f"{types}<ModelVariables>")
    text = text.replace(TIME_CONSTANT, '<Real declaredType="Time" start="0.1" max="5"/>')
    found = read_description(written(tmp_path / "a.fmu", text)).parameters["T"]
    assert (found.unit, found.min, found.max, found.nominal, found.start, found.description) == ("s", 0, 5, 2, 0.1, "")
    types = '<TypeDefinitions><UInt8Type name="Count" description="a number" min="1" max="9"/></TypeDefinitions>'
    text = description(PLAIN, 3).replace("<ModelVariables>", f"{types}<ModelVariables>")
    count = '<UInt8 name="n" valueReference="8" causality="parameter" declaredType="Count" start="3"><Alias name="m"/>'
    text = text.replace("</ModelVariables>", f"{count}</UInt8></ModelVariables>")
    found = read_description(written(tmp_path / "b.fmu", text, version=3)).parameters["n"]
    assert (found.min, found.max, found.start, found.description) == (1, 9, 3, "a number")
    assert found.variability == "fixed" and found.also == ("m",) and found.whole


def test_a_parameter_that_is_constant_stays_as_it_is(tmp_path):
    """The standard knows none, but tools write it."""
    text = description(PLAIN, 2).replace(
        'causality="parameter" variability="tunable"', 'causality="parameter" variability="constant"'
    )
    assert not read_description(written(tmp_path / "a.fmu", text)).parameters


@settings(max_examples=60)
@given(place=st.integers(0, 10_000), byte=st.integers(0, 255), cut=st.booleans())
def test_a_damaged_file_is_read_or_refused_with_a_reason(tmp_path_factory, place, byte, cut):
    path = tmp_path_factory.mktemp("f") / "a.fmu"
    whole = bytearray(written(path).read_bytes())
    at = place % len(whole)
    whole[at] = byte
    path.write_bytes(whole[: at + 1] if cut else whole)
    try:
        load_model(path)
    except InputError as e:
        assert str(path) in str(e)
