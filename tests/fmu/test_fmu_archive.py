"""Archives and descriptions that are refused before anything of them is unpacked or run."""

from __future__ import annotations

import re
import stat
import zipfile
from itertools import pairwise

import fmpy
import pytest
from c_fmu import CModel, Var, description
from fmpy import platform, platform_tuple, sharedLibraryExtension
from hypothesis import given, settings
from hypothesis import strategies as st

from hvdc_ident import load_model
from hvdc_ident.errors import InputError, ModelError
from hvdc_ident.fmu import archive as checks
from hvdc_ident.fmu import compile_fmu, read_capabilities, read_description

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
    built = written(tmp_path / "c.fmu", version=3, entries=[("sources/buildDescription.xml", bomb)])
    with pytest.raises(ModelError, match=r"buildDescription.*DOCTYPE"):
        load_model(built)


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
    monkeypatch.setattr(fmpy, "read_model_description", lambda *_, **__: pytest.fail("the variables were read"))
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
    assert found.parameters["T"].start == 0.1 and found.parameters["T"].tunable
    assert list(found.outputs) == ["y"] and list(found.inputs) == ["u"]


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
