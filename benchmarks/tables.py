"""The tables of all measurements, from the records in the cache: ``python -m benchmarks.tables`` draws them again."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import figures
from benchmarks.comparison import POSE, against_colmap, luck, no_harm
from benchmarks.markdown import table
from benchmarks.plan import COLMAP, DEGRADED, KITCHEN, OTHERS, STUDIO
from benchmarks.scores import (
    Label,
    Records,
    by_label,
    by_shot,
    given_aucs,
    largest_parallax,
    parallax_of,
    pooled_depth,
    pose_aucs,
    relative_pose_aucs,
    smallest_parallax,
    within_at_own_scale,
)
from benchmarks.store import Record, load

HERE = Path(__file__).parent
WITHIN = ("points within 5 % of depth", "the same, at its own scale")
DEPTH = (
    ["within 5%", "delta<1.05", "delta<1.05^2", "delta<1.05^3", "delta<1.25", "delta<1.25^2", "delta<1.25^3"]
    + [f"theta<{cm}cm" for cm in (1, 2, 5, 10, 25)]
    + ["points"]
)


def draw(output: Path, cache: Path) -> None:
    """Write RESULTS.md and the figures of the experiments in the manifest of the output folder."""
    manifest = json.loads((output / "manifest.json").read_text())
    experiments = {name: [load(cache / record) for record in facts["records"]] for name, facts in manifest.items()}
    parts = ["# Results", _provenance(manifest, experiments)]
    for name, (title, section) in SECTIONS.items():
        if name in experiments:
            parts += [f"## {title}", *section(experiments[name], output)]
    parts += [
        *against_colmap(experiments),
        *no_harm(experiments),
        *luck(experiments),
        *_cost(experiments),
        *_failures(experiments),
    ]
    if any(parallax_of(record) for records in experiments.values() for record in records):
        figures.parallax_histogram([r for records in experiments.values() for r in records], output / "parallax.png")
        parts += ["## Parallax of the shots", "![Number of shots by parallax](parallax.png)"]
    (output / "RESULTS.md").write_text("\n\n".join(parts) + "\n")


def pose_table(records: Records) -> str:
    """The six AUC columns by method and prior, pooled over all frames."""
    rows = []
    for label, members in by_label(records).items():
        frames = sum(len(r.arrays["indices"]) for r in members)
        registered = 100.0 * sum(r.registered for r in members) / frames
        within = pooled_depth(members)["within 5%"], within_at_own_scale(members)
        rows.append([*_names(label), len(members), *pose_aucs(members), registered, *within])
    return table(["method", "prior", "shots", *POSE, "frames registered %", *WITHIN], rows, max)


def given_table(records: Records) -> list[str]:
    """The six AUC columns of the causal poses; empty if no method has any."""
    rows = [
        [*_names(label), len(members), *columns]
        for label, members in by_label(records).items()
        if (columns := given_aucs(members)) is not None
    ]
    if not rows:
        return []
    return [
        "Causal poses, as given frame by frame; a frame that waits for its pose counts as an infinite error.",
        table(["method", "prior", "shots", *POSE], rows, max),
    ]


def shot_tables(records: Records) -> list[str]:
    """The pose table of every shot."""
    parts = []
    for shot, members in by_shot(records).items():
        value = parallax_of(members[0])
        parts += [f"#### {shot}" + (f" (parallax {value:.3f})" if value else ""), pose_table(members)]
    return parts


def depth_table(records: Records) -> str:
    """Depth of the observed points: relative and absolute accuracy in percent of the points."""
    rows = [
        [*_names(label), *(summary[key] for key in DEPTH)]
        for label, members in by_label(records).items()
        for summary in [pooled_depth(members)]
    ]
    return table(["method", "prior", *DEPTH], rows)


def _pose(records: Records, output: Path) -> list[str]:
    main = [r for r in records if r.cell.method not in ("paper-init-only", "paper-opt-only")]
    variants = [r for r in records if r.cell.method not in COLMAP]
    parts = [
        "Area under the recall curve in percent, pooled over all frames; a frame that is not registered counts as an "
        "infinite error. The best of each column is bold. The alignment of the paths scales the depths; at its own "
        "scale, they are scaled to a median ratio of 1 to the truth.",
        "### All shots",
        pose_table(main),
    ]
    for title, chosen in (("largest", largest_parallax(main)), ("smallest", smallest_parallax(main))):
        parts += [f"### The 30 % of shots with the {title} parallax ({_shots(chosen)})", pose_table(chosen)]
    figures.recall_curves(main, output / "recall.png")
    figures.recall_curves(smallest_parallax(main), output / "recall_small.png")
    figures.error_against_parallax(main, output / "ate_parallax.png")
    figures.depth_recall(main, output / "depth_recall.png")
    return [
        *parts,
        "### Recall curves",
        "All shots:\n\n![Recall curves of all shots](recall.png)",
        "The shots with the smallest parallax:\n\n![Recall curves, smallest parallax](recall_small.png)",
        "### Error against parallax",
        "![Median ATE of each shot and method against the parallax](ate_parallax.png)",
        "### Method variants",
        pose_table(variants),
        "### Depth of the points",
        "Percent of the observed points with known true depth, away from its edges; scale from the alignment of the "
        "trajectories. `delta`: ratio, `theta`: absolute.",
        depth_table(records),
        "![Recall of the point depths](depth_recall.png)",
        "### Shot by shot",
        *shot_tables(records),
    ]


def _real(records: Records, output: Path) -> list[str]:
    """Median errors and AUC of relative poses, shot by shot; the references are too different to be pooled."""
    rows = []
    for shot, members in by_shot(records).items():
        for label, (record,) in by_label(members).items():
            errors, n = record.errors, len(record.arrays["indices"])
            medians = [float(np.median(e)) for e in (errors.ate * 1e3, errors.t_rpe * 1e3)]
            rotation = float(np.median(errors.r_rpe))
            rows.append(
                [
                    *(shot, *_names(label), f"{record.registered}/{n}", *medians),
                    f"{rotation:.3f}" if np.isfinite(rotation) else "–",
                    *relative_pose_aucs(record),
                    record.depth_errors.summary()["within 5%"],
                    within_at_own_scale([record]),
                ]
            )
    medians_of = ["ATE mm", "T-RPE mm", "R-RPE °"]
    relative = ["pose AUC@1°", "@5°", "@20°"]
    header = ["shot", "method", "prior", "frames", *medians_of, *relative, *WITHIN]
    return ["Medians over the frames, and the AUC of the relative poses of all pairs in percent.", table(header, rows)]


def _edge(records: Records, output: Path) -> list[str]:
    rows = []
    for shot, members in by_shot(records).items():
        for label, (record,) in by_label(members).items():
            angles, n = record.rotation_errors, len(record.arrays["indices"])
            rows.append(
                [
                    *(shot, *_names(label), f"{record.registered}/{n}"),
                    *(f"{value:.3f}" if np.isfinite(value) else "–" for value in (np.median(angles), angles.max())),
                    record.facts.get("kind", "–"),
                    " ".join(record.facts.get("notes", [])) or "–",
                ]
            )
    header = ["shot", "method", "prior", "frames", "rotation error °, median", "largest", "reported as", "notes"]
    return ["A camera that only rotates, and one that does not move.", table(header, rows)]


def _split(records: Records, output: Path) -> list[str]:
    """Tables of the rendered shots and of the kitchen clips."""
    parts = []
    for title, shots in (("Rendered shots", STUDIO), ("Kitchen clips", KITCHEN)):
        if members := [r for r in records if r.cell.shot in shots]:
            parts += [f"### {title}", pose_table(members), *given_table(members), *shot_tables(members)]
    return parts


def _pooled(records: Records, output: Path) -> list[str]:
    return [pose_table(records), *given_table(records), *shot_tables(records)]


def _degraded(records: Records, output: Path) -> list[str]:
    parts = []
    for variant, members in _group(records, lambda r: r.cell.variant).items():
        what = "Gaussian blur 1 px, noise sigma 8, JPEG quality 40" if variant == DEGRADED else "H.264 at CRF 30"
        parts += [f"### {what}", pose_table(members), *given_table(members), *shot_tables(members)]
    return parts


def _networks(records: Records, output: Path) -> list[str]:
    parts = []
    for title, rendered in (("Rendered shots", True), ("Real sets with sensor depth", False)):
        if members := [r for r in records if (r.cell.shot in STUDIO) == rendered]:
            parts += [f"### {title}", pose_table(members)]
    return [*parts, "With the sensor as prior, the depth of the points is compared with the same sensor."]


SECTIONS: Mapping[str, tuple[str, Callable[[Records, Path], list[str]]]] = {
    "pose": ("Camera path on shots with little parallax", _pose),
    "real": ("Real and other clips", _real),
    "wide": ("Wide baseline", _real),
    "sets": ("Frames of shots as unordered sets", _real),
    "edge": ("Rotation only, and no motion", _edge),
    "short": ("The first 10 frames", _split),
    "few": ("At most 40 tracks", _pooled),
    "degraded": ("Degraded footage, first 30 frames", _degraded),
    "useless": ("Useless priors", _pooled),
    "networks": ("Depth networks", _networks),
    "noise": ("Noise on the true depth", _pooled),
    OTHERS: ("Other sets", _real),
}


def _cost(experiments: Mapping[str, Records]) -> list[str]:
    records = experiments.get("pose", [])
    if not records:
        return []
    parts = [
        "## Time and memory",
        "From the video to the written result. Wall time depends on other work of the machine, whose load at the start "
        "is given; CPU time hardly does. The mappers of COLMAP share their matching, which counts for each of them.",
        "### Mean by method",
    ]
    stages: dict[str, None] = {}
    for record in records:
        stages |= dict.fromkeys(stage for stage in record.facts["seconds"] if stage != "total")
    rows = []
    for label, all_members in by_label(records).items():
        members = [r for r in all_members if not r.facts["failed"]]
        if members:
            by_stage = [np.mean([r.facts["seconds"].get(stage, np.nan) for r in members]) for stage in stages]
            rows.append([*_names(label), *map(float, by_stage), *map(float, np.mean([_costs(r) for r in members], 0))])
    parts.append(table(["method", "prior", *stages, "total s", "CPU s", "peak MB", "load"], rows))
    rows = []
    for shot, members in by_shot(records).items():
        labels = {label: record for label, (record,) in by_label(members).items() if not record.facts["failed"]}
        tuned, ours = labels.get(Label("colmap_tuned", "none")), labels.get(Label("default", "tcmonodepth"))
        if tuned and ours:
            wall, cpu, *_ = np.array(_costs(tuned)) / np.array(_costs(ours))
            rows.append([shot, *_costs(ours), *_costs(tuned), float(wall), float(cpu)])
    if rows:
        columns = [f"{who} {what}" for who in ("default", "tuned") for what in ("s", "CPU s", "MB", "load")]
        header = ["shot", *columns, "ratio s", "ratio CPU s"]
        parts += ["### Against tuned COLMAP", table(header, rows)]
    return parts


def _costs(record: Record) -> list[float]:
    facts = record.facts
    return [facts["seconds"]["total"], facts["cpu_seconds"], facts["peak_mb"], facts["load"]]


def _failures(experiments: Mapping[str, Records]) -> list[str]:
    failed = {
        record.cell: record.facts["failed"]
        for records in experiments.values()
        for record in records
        if record.facts["failed"]
    }
    rows = [[c.shot, c.variant, c.method, c.prior, reason] for c, reason in failed.items()]
    header = ["shot", "variant", "method", "prior", "reason"]
    return ["## Failures", table(header, rows) if rows else "None."]


def _provenance(manifest: Mapping[str, Any], experiments: Mapping[str, Records]) -> str:
    rows = [
        [name, facts["commit"], facts["date"], len(experiments[name]), f"`{facts['command']}`"]
        for name, facts in manifest.items()
    ]
    machines = dict.fromkeys(facts["machine"] for facts in manifest.values())
    versions = dict.fromkeys(
        ", ".join(f"{name} {number}" for name, number in facts["versions"].items()) for facts in manifest.values()
    )
    return "\n\n".join(
        [
            "Generated by `python -m benchmarks.run`; + marks a commit with uncommitted changes.",
            table(["experiment", "commit", "date", "cells", "command"], rows),
            *(f"Machine: {machine}." for machine in machines),
            *(f"Versions: {numbers}." for numbers in versions),
        ]
    )


def _names(label: Label) -> tuple[str, str]:
    return label.method, label.prior if label.prior != "none" else "–"


def _shots(records: Records) -> str:
    return ", ".join(shot.split("_")[0] for shot in by_shot(records))


def _group(records: Records, key: Callable[[Record], str]) -> dict[str, list[Record]]:
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(key(record), []).append(record)
    return groups


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tables", description=__doc__)
    parser.add_argument("--output", type=Path, default=HERE / "results", help="folder with the manifest of a run")
    parser.add_argument("--cache", type=Path, default=HERE / "cache", help="folder of the records")
    arguments = parser.parse_args()
    draw(arguments.output, arguments.cache)


if __name__ == "__main__":
    main()
