"""The tracks of Tracker4 nodes in a script of Nuke."""

from __future__ import annotations

import re
from collections.abc import Iterator

_TOKEN = re.compile(r'\s*(?:(\{)|(\})|"((?:[^"\\]|\\.)*)"|([^\s{}"]+))', re.DOTALL)

Item = str | list["Item"]


def nuke_tracks(text: str) -> dict[str, dict[int, tuple[float, float]]]:
    """The places of each track by frame, pixels from the bottom left corner.

    Raises:
        ValueError: the script is not whole, or a node has no tracks.
    """
    found: dict[str, dict[int, tuple[float, float]]] = {}
    for start in re.finditer(r"^\s*Tracker4\s*\{", text, re.MULTILINE):
        for name, x, y in _rows(_list(_TOKEN.finditer(text, start.end()))):
            if name in found:
                raise ValueError(f'track "{name}" is there twice')
            columns = _curve(x), _curve(y)
            shared = columns[0].keys() & columns[1].keys()
            if shared:
                found[name] = {frame: (columns[0][frame], columns[1][frame]) for frame in shared}
    return found


def _list(tokens: Iterator[re.Match[str]]) -> list[Item]:
    """A list in braces, after its opening one."""
    items: list[Item] = []
    for token in tokens:
        opens, closes, quoted, word = token.groups()
        if closes:
            return items
        items.append(_list(tokens) if opens else re.sub(r"\\(.)", r"\1", quoted) if quoted is not None else word)
    raise ValueError("a brace in the Tracker4 node is not closed")


def _rows(node: list[Item]) -> Iterator[tuple[str, Item, Item]]:
    """Name and the curves of both coordinates of each track of a node."""
    knobs = dict(zip((k for k in node[::2] if isinstance(k, str)), node[1::2], strict=False))
    tracks = knobs.get("tracks")
    if not isinstance(tracks, list) or len(tracks) < 3 or not all(isinstance(part, list) for part in tracks[1:3]):
        raise ValueError("a Tracker4 node has no table of tracks")
    columns, rows = tracks[1:3]
    names = [column[3] if isinstance(column, list) and len(column) > 3 else "" for column in columns]
    if missing := [wanted for wanted in ("name", "track_x", "track_y") if wanted not in names]:
        raise ValueError(f"the table of a Tracker4 node has no column {missing[0]}")
    name, x, y = (names.index(wanted) for wanted in ("name", "track_x", "track_y"))
    for row in rows:
        if not isinstance(row, list) or len(row) <= max(name, x, y) or not isinstance(row[name], str):
            raise ValueError("a track of a Tracker4 node has fewer values than columns")
        yield str(row[name]), row[x], row[y]


def _curve(item: Item) -> dict[int, float]:
    """Keys by frame of ``curve x1001 12.5 12.7 x1005 13``: a value without a frame is for the one that follows."""
    words = item if isinstance(item, list) else []
    keys: dict[int, float] = {}
    frame: int | None = None
    for word in words[1:] if words[:1] == ["curve"] else []:
        if not isinstance(word, str):
            raise ValueError("a curve of a Tracker4 node holds an expression")
        if re.fullmatch(r"x-?\d+", word):
            frame = int(word[1:])
        elif frame is not None and re.fullmatch(r"[-+.\d][-+.\deE]*", word):
            keys[frame] = float(word)
            frame += 1
    return keys
