"""The report's section on the linear model."""

import json

from typer.testing import CliRunner

from hvdc_ident.cli import app


def test_the_page_shows_modes_limits_and_bode(tmp_path):
    study = tmp_path / "s.toml"
    study.write_text(
        'schema = 1\nname = "l"\n[model]\nsource = "vsc-hvdc-link"\n'
        '[linearize]\ninputs = ["Vdcref1"]\noutputs = ["Irorder1", "Vdc1"]\n'
    )
    result = CliRunner().invoke(app, ["run", str(study), "--out", str(tmp_path / "r"), "--quiet"])
    assert result.exit_code == 0, result.output
    page = (tmp_path / "r/report.html").read_text()
    for words in ("Linear model", "stable", "Vdcref1 to Vdc1", "Active limits: none", "xv 0."):
        assert words in page, words
    data = json.loads((tmp_path / "r/linearization.json").read_text())
    assert len(data["frequency_response"]["omega"]) > 100
