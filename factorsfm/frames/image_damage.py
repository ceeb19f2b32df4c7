"""Damage that decoders keep to themselves, or tell on standard error past all logging: found in the bytes of a file."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from typing import Literal

Damage = Literal["", "truncated", "damaged", "doubtful"]

_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_JPEG_START, _JPEG_END = b"\xff\xd8", 0xD9
_JPEG_MARKER = re.compile(rb"\xff([^\x00\xff\xd0-\xd7])", re.DOTALL)  # without stuffed bytes and restart markers
_BASELINE, _TABLES, _SCAN = 0xC0, 0xC4, 0xDA
# Tables, restart interval, number of lines, comments and data of applications: what may follow on a scan.
_AFTER_SCAN = frozenset({_TABLES, 0xCC, _JPEG_END, _SCAN, 0xDB, 0xDC, 0xDD, 0xFE, *range(0xE0, 0xF0)})
_HOLE = bytes(64)  # a block of a disk that was never written is far longer
_PADDING = re.compile(rb"\x00*\xff[^\x00]", re.DOTALL)
_ZEROS = re.compile(rb"\x00{8,}(\xff[^\x00])?", re.DOTALL)  # with the marker after them
_END_OF_BLOCK = 0  # symbol of a Huffman table
_RIFF, _WEBP, _LOSSY, _LOSSLESS = b"RIFF", b"WEBP", b"VP8 ", b"VP8L"
_FLAT_PIXELS = 1024  # of a WebP of one colour, that are written as no more than a byte of zeros


def damage_of(data: bytes) -> Damage:
    """What is wrong with the bytes of a JPEG, PNG or WebP file; nothing is known of others.

    doubtful: a JPEG that is damaged if libjpeg complains of it, with and without the zeros that fill it up.
    """
    if data.startswith(_PNG_START):
        return _damage_of_png(data)
    if data.startswith(_RIFF) and data[8:12] == _WEBP:
        return _damage_of_webp(data)
    return _damage_of_jpeg(data) if data.startswith(_JPEG_START) else ""


def without_padding(data: bytes) -> bytes:
    """A JPEG without the zeros before its markers, which may also be the end of a scan."""
    return _ZEROS.sub(lambda zeros: zeros[1] or zeros[0], data)


def _damage_of_png(data: bytes) -> Damage:
    """The end is missing, or the checksum of a chunk that libpng needs is wrong."""
    if _PNG_END not in data:
        return "truncated"
    view, position = memoryview(data), len(_PNG_START)
    while position < len(data):
        size, kind = int.from_bytes(view[position : position + 4], "big"), bytes(view[position + 4 : position + 8])
        end = position + 8 + size
        is_needed = kind[:1].isupper()
        if is_needed and zlib.crc32(view[position + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            return "damaged"
        if kind == b"IEND":
            return ""
        position = end + 4
    return "damaged"


def _damage_of_webp(data: bytes) -> Damage:
    """The end is missing, or the image holds more zeros in a row than one of its size that shows a single colour."""
    end = 8 + int.from_bytes(data[4:8], "little")
    if end > len(data):
        return "truncated"
    position = 12
    while position + 8 <= end:
        kind, size = data[position : position + 4], int.from_bytes(data[position + 4 : position + 8], "little")
        position += 8
        if kind in (_LOSSY, _LOSSLESS):
            width, height = _size_of_webp(kind, data[position : position + 10])
            zeros = bytes(len(_HOLE) + width * height // _FLAT_PIXELS)
            if data.find(zeros, position, position + size) >= 0:
                return "damaged"
        position += size + size % 2
    return ""


def _size_of_webp(kind: bytes, header: bytes) -> tuple[int, int]:
    """Width and height: 14 bits each, after a tag and a mark, or after a byte and less one."""
    if kind == _LOSSY:
        return int.from_bytes(header[6:8], "little") % 2**14, int.from_bytes(header[8:10], "little") % 2**14
    bits = int.from_bytes(header[1:5], "little")
    return bits % 2**14 + 1, (bits >> 14) % 2**14 + 1


def _damage_of_jpeg(data: bytes) -> Damage:
    """The end is missing, or a scan holds a marker that cannot be there, or a hole: zeros before further data.

    Zeros are the shortest code again and again. In a scan of a baseline JPEG that holds a component in which this code
    is not the end of a block, no image is written so: all of its coefficients would be the same.
    """
    first_symbols: dict[int, int] = {}
    used: list[int] = []  # Huffman tables of the scan
    baseline, in_scan, doubtful, end = False, False, False, len(_JPEG_START)
    for marker, start, stop in _segments(data):
        if in_scan:
            if marker not in _AFTER_SCAN:
                return "damaged"
            if _has_hole(data, end, start):
                if baseline and any(first_symbols.get(table, _END_OF_BLOCK) != _END_OF_BLOCK for table in used):
                    return "damaged"
                doubtful = True
        segment = data[start + 4 : stop]
        baseline = baseline or marker == _BASELINE
        if marker == _TABLES:
            first_symbols |= _first_symbols(segment)
        in_scan, end = marker == _SCAN, stop
        used = [segment[k + 1] & 15 for k in range(1, len(segment) - 4, 2)] if in_scan else []
        if marker == _JPEG_END:
            return "doubtful" if doubtful else ""
    return "truncated"


def _segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Marker, begin and end of each segment: a marker, its length in two bytes, and what belongs to it."""
    position = len(_JPEG_START)
    while found := _JPEG_MARKER.search(data, position):
        position = found.end() + int.from_bytes(data[found.end() : found.end() + 2], "big")
        yield found[1][0], found.start(), position


def _has_hole(data: bytes, start: int, stop: int) -> bool:
    """Whether zeros lie before further data; those before a marker fill up."""
    while (start := data.find(_HOLE, start, stop)) >= 0:
        padding = _PADDING.match(data, start)
        if padding is None:
            return True
        start = padding.end()
    return False


def _first_symbols(tables: bytes) -> dict[int, int]:
    """The symbol with the code of nothing but zeros, by the number of the Huffman table for all but the mean."""
    found, position = {}, 0
    while position + 17 < len(tables):
        kind, number = divmod(tables[position], 16)
        if kind == 1:
            found[number] = tables[position + 17]
        position += 17 + sum(tables[position + 1 : position + 17])
    return found
