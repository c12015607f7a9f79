"""The same kinds of input, spoilt by a fuzzer that watches which lines run; for a night, not for the tests.

    pip install atheris
    python -m tests.hostile.atheris_fuzz csv -max_total_time=3600

Everything after the kind is libFuzzer's. It stops at the first input that ends in anything but an InputError, and keeps
that input in a file of the working folder.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["hvdc_ident"]):
    from tests.hostile import fuzz


def main() -> None:
    """Run until libFuzzer is told to stop."""
    name = sys.argv.pop(1) if len(sys.argv) > 1 else ""
    if name not in fuzz.KINDS:
        sys.exit(f"which kind? one of {', '.join(sorted(fuzz.KINDS))}")
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    kind = fuzz.KINDS[name]
    corpus = Path(tempfile.mkdtemp(prefix="corpus-"))
    for number, example in enumerate(kind.good(folder)):
        (corpus / str(number)).write_bytes(example)

    def one(content: bytes) -> None:
        if bad := fuzz.outcome(kind, content, folder):
            raise AssertionError(bad)

    atheris.Setup([*sys.argv, str(corpus)], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
