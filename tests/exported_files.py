"""Plain readers of what exports write: folders, and files for Nuke and After Effects."""

import json
import re
from pathlib import Path


def exported(folder: Path) -> set[str]:
    """Names of what is in the folder of an export, all of which its list knows."""
    entries = {path.relative_to(folder).as_posix() for path in folder.rglob("*")} - {".factorsfm"}
    assert entries == {*json.loads((folder / ".factorsfm").read_text())["entries"]}
    return {name for name in entries if "/" not in name}


def nuke_nodes(text: str) -> dict[str, dict[str, str]]:
    """Knobs of the nodes by name."""
    nodes = {}
    for kind, body in re.findall(r"^(\w+) \{\n(.*?)^\}$", text, re.MULTILINE | re.DOTALL):
        knobs = dict(line[1:].split(" ", 1) for line in body.splitlines())
        nodes[knobs.get("name", kind)] = {"class": kind, **knobs}
    return nodes


def nuke_curves(knob: str) -> dict[int, list[float]]:
    curves = [re.findall(r"x(-?\d+) (\S+)", curve) for curve in re.findall(r"\{curve ([^}]*)\}", knob)]
    keys = [[int(frame) for frame, _ in curve] for curve in curves]
    assert all(frames == keys[0] for frames in keys)
    return {frame: [float(curve[i][1]) for curve in curves] for i, frame in enumerate(keys[0])}


def after_effects_tracks(text: str) -> tuple[dict[str, str], dict[str, dict[int, list[float]]]]:
    lines = text.split("\n")
    assert lines[0] == "Adobe After Effects 8.0 Keyframe Data"
    assert lines[-2] == "End of Keyframe Data"
    header = dict(line[1:].split("\t") for line in lines[2:7])
    tracks: dict[str, dict[int, list[float]]] = {}
    for line in lines[8:-2]:
        if line and not line.startswith("\t"):
            tracks[line] = current = {}
        elif line.startswith("\t") and not line.startswith("\tFrame"):
            frame, *values = line.strip("\t").split("\t")
            current[int(frame)] = [float(value) for value in values]
    return header, tracks
