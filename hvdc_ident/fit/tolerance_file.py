"""The file of a tolerance profile, table by table."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from hvdc_ident.toml_tables import NotNegative, TomlTable


class WindowsTable(TomlTable):
    """[windows]: lengths of the windows and of what is left out between them, s; settling: a share of the change."""

    before: NotNegative
    gap_before: NotNegative
    gap_start: NotNegative
    gap_end: NotNegative
    gap_cleared: NotNegative
    after: NotNegative
    settling: NotNegative


class ErrorsTable(TomlTable):
    """The largest errors of one window: of a row, of the mean, and of the mean absolute error."""

    max: NotNegative
    mean: NotNegative
    mean_absolute: NotNegative


class LimitsTable(TomlTable):
    """[limits]: of the three windows, in `unit`."""

    unit: str
    before: ErrorsTable
    during: ErrorsTable
    after: ErrorsTable


class ProfileFile(TomlTable):
    """The whole file; source and notes: where the numbers come from."""

    format: Literal[1] = Field(alias="schema")
    name: str
    version: str
    title: str
    source: str
    notes: str
    windows: WindowsTable
    limits: LimitsTable
