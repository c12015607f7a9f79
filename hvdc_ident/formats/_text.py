"""Text of files that do not say in which code page they are written."""

from __future__ import annotations

import codecs
import re

WIDE = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)

_ASCII = bytes(range(128))
_CYRILLIC = re.compile(rb"(?<![A-Za-z\x80-\xff])[\xc0-\xff\xa8\xb8]{2,}(?![A-Za-z\x80-\xff])")  # words of nothing else
_HANZI = rb"[\xa1-\xa9\xb0-\xd7][\xa1-\xfe]"  # symbols and the 3755 usual characters of GB 2312
_TWO_BYTES = {
    "gb18030": re.compile(rb"(?:%b){2,}|(?<![A-Za-z])%b|%b(?![A-Za-z])" % (_HANZI, _HANZI, _HANZI)),
    "cp932": re.compile(rb"[\x81-\x83\x88-\x97][\x40-\x7e\x80-\xfc]"),  # kana and the usual characters of JIS X 0208
}
_WORDS = 0.7  # share of the bytes beyond ASCII in such words
_USUAL = 0.9  # and in such characters


def encoding_of(top: bytes) -> str:
    """Return the encoding of a text from its first bytes: UTF-16 where they say so, UTF-8, else a code page of Windows.

    Words of Cyrillic letters are cp1251, pairs of bytes that are usual Chinese or Japanese characters gb18030 or cp932. A letter among
    plain ones is an accent of Western Europe, cp1252.
    """
    if top.startswith(WIDE):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(top)
        return "utf-8-sig"
    except UnicodeDecodeError:
        pass
    high = _beyond_ascii(top)
    if high - _beyond_ascii(_CYRILLIC.sub(b"", top)) >= _WORDS * high:
        return "cp1251"
    for name, usual in _TWO_BYTES.items():
        if high - _beyond_ascii(usual.sub(b"", top)) >= _USUAL * high:
            return name
    return "cp1252"


def decoded(content: bytes) -> str:
    """Return a whole text, with a question mark for what its encoding does not have."""
    return content.decode(encoding_of(content), "replace")


def _beyond_ascii(text: bytes) -> int:
    return len(text.translate(None, _ASCII))
