"""What is measured: experiments, which are lists of cells (shot, variant, method, prior)."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

STUDIO = (
    "d01_livingroom_dolly_in",
    "d02_livingroom_truck_actor",
    "d03_livingroom_handheld",
    "d04_warehouse_crane",
    "d05_warehouse_walk_arc",
    "d06_keep_static_breath",
    "d07_keep_pan_trans_actor",
    "d08_arena_pedestal",
)
KITCHEN = ("kitchen-000", "kitchen-528", "kitchen-840")
SENSOR = (*KITCHEN, "hololens-110", "desk-9")
REAL = (*SENSOR, "tsukuba-000", "tsukuba-100")
UNORDERED = ("fountain-P11", "herzjesu-P8")
WIDE_VIDEO = ("d09_livingroom_wide",)
EDGE = ("d10_keep_tripod_pan", "euroc-static")

COLMAP = ("colmap_default", "colmap_tuned", "colmap_global")
PAPER = ("paper", "paper-init-only", "paper-opt-only")
NO_PRIOR = "none"
NETWORKS = ("tcmonodepth", "fastdepth")
USELESS = ("image-row", "random-field")
NOISE = ("noise-0", "noise-0.1", "noise-0.2", "noise-0.4")

FULL, FIRST_10, FIRST_20, FEW, DEGRADED, CRF_30 = "full", "first-10", "first-20", "tracks-40", "degraded", "crf-30"
AS_SET = "as-set"  # the frames as an unordered set
DRAWS = (1, 2, 3)  # seeds of faint noise, which show how much of a difference is chance


def drawn(variant: str, draw: int) -> str:
    """The variant with faint noise on its frames, with which other tracks survive."""
    return f"{variant}~{draw}"


def undrawn(variant: str) -> tuple[str, int]:
    """The variant without faint noise, and the seed of the noise, 0 without."""
    name, _, draw = variant.partition("~")
    return name, int(draw or 0)


@dataclass(frozen=True, slots=True)
class Cell:
    """One measurement.

    Attributes:
        shot: name of a set.
        variant: change of the footage or the tracker, see `inputs.VARIANTS`.
        method: a preset of factorsfm or a baseline.
        prior: see `inputs.open_prior`; "none" for methods without a prior.
    """

    shot: str
    variant: str
    method: str
    prior: str

    def __str__(self) -> str:
        return f"{self.shot}  {self.variant}  {self.method}  {self.prior}"


def _cells(
    shots: Iterable[str],
    methods: Iterable[str],
    priors: Iterable[str] = (NO_PRIOR,),
    variants: Iterable[str] = (FULL,),
) -> list[Cell]:
    """All combinations; a method without a prior occurs once."""
    cells = [
        Cell(shot, variant, method, NO_PRIOR if method == "geometry" or method in COLMAP else prior)
        for shot in shots
        for variant in variants
        for method in methods
        for prior in priors
    ]
    return list(dict.fromkeys(cells))


_BOTH = ("tcmonodepth", "simulated")
_THREE = ("default", "paper", "geometry")

EXPERIMENTS: dict[str, list[Cell]] = {
    "pose": _cells(STUDIO, ("default", *PAPER, "geometry", *COLMAP), _BOTH),
    "real": _cells(REAL, (*_THREE, *COLMAP), ("tcmonodepth",)),
    "wide": _cells((*UNORDERED, *WIDE_VIDEO), ("default", "geometry", *COLMAP), ("tcmonodepth",)),
    "sets": _cells((*WIDE_VIDEO, *KITCHEN), ("default", "geometry"), ("tcmonodepth",), (AS_SET,))
    + _cells((*WIDE_VIDEO, *KITCHEN), COLMAP),
    "edge": _cells(EDGE, (*_THREE, *COLMAP), ("tcmonodepth",)),
    "short": _cells(STUDIO, (*_THREE, "colmap_tuned"), _BOTH, (FIRST_10,))
    + _cells(KITCHEN, (*_THREE, "colmap_tuned"), ("tcmonodepth",), (FIRST_10,)),
    "few": _cells(STUDIO, _THREE, _BOTH, (FEW,)),
    "degraded": _cells(STUDIO, (*_THREE, "colmap_tuned"), _BOTH, (DEGRADED, CRF_30)),
    "useless": _cells(STUDIO, ("default", "geometry"), USELESS),
    "luck": [
        *_cells(STUDIO, _THREE, _BOTH, [drawn(FULL, k) for k in DRAWS]),
        *_cells(STUDIO[3:5] + STUDIO[6:], _THREE, _BOTH, [drawn(FEW, k) for k in DRAWS]),
        *_cells(STUDIO[4:5], _THREE, _BOTH, [drawn(DEGRADED, k) for k in DRAWS]),
    ],
    "networks": _cells(STUDIO, ("default",), (*NETWORKS, "simulated"))
    + _cells(SENSOR, ("default",), (*NETWORKS, "sensor")),
    "noise": _cells(STUDIO, ("default", "paper"), NOISE),
}

QUICK = {
    "pose": _cells((STUDIO[2], STUDIO[5]), ("default", *PAPER, "geometry", *COLMAP), _BOTH, (FIRST_10,)),
    "short": _cells((STUDIO[2], *KITCHEN[:1]), (*_THREE, "colmap_tuned"), ("tcmonodepth",), (FIRST_10,)),
    "edge": _cells(EDGE[:1], ("default",), ("tcmonodepth",)),
}

OTHERS = "others"  # the experiment with the sets in the data folder that no other experiment names


def planned(sets: Collection[str], quick: bool) -> dict[str, list[Cell]]:
    """The experiments on the sets of these names."""
    named = {cell.shot for cells in EXPERIMENTS.values() for cell in cells}
    others = _cells(sorted(set(sets) - named), (*_THREE, *COLMAP), ("tcmonodepth",))
    plan = QUICK if quick else {**EXPERIMENTS, OTHERS: others}
    return {name: [cell for cell in cells if cell.shot in sets] for name, cells in plan.items()}
