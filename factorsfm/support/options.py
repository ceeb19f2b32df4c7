"""Options: frozen dataclasses with units in the names, and the named presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from factorsfm.support.errors import InputError

FOCAL_STD = 0.016  # relative standard deviation up to which a focal length counts as determined
GUESSED_FOCAL_STD = 0.3  # of a focal length that nothing tells: fields of view of 30 to 75 degrees
GIVEN_FOCAL_STD = 0.05  # of one from EXIF data or a camera file that is to be refined

LensFreedom = Literal["auto", "fixed", "focal", "radial", "distortion", "all", "zoom"]
ShutterUse = Literal["auto", "global", "rolling"]
DepthUse = Literal["none", "paper", "inverse"]


@dataclass(frozen=True, slots=True)
class TrackerOptions:
    """Tracking in video (`tracks.flow`).

    Attributes:
        max_tracks: tracks alive at a time.
        replenish_below: start new tracks when this share of `max_tracks` is free.
        window_px: side of the Lucas-Kanade window.
        levels: pyramid levels above the full image in the flow from frame to frame.
        border_px: distance to the image border that tracks keep.
        flow_check_px: largest forward-backward error of the flow from frame to frame.
        realign_check_px: largest forward-backward error of the re-alignment with the birth patch.
        realign_reach_px: largest correction by the re-alignment.
        corner_quality: weakest corner as a share of the strongest (Shi-Tomasi).
    """

    max_tracks: int = 1000
    replenish_below: float = 0.1
    window_px: int = 21
    levels: int = 4
    border_px: int = 6
    flow_check_px: float = 0.7
    realign_check_px: float = 0.3
    realign_reach_px: float = 3.0
    corner_quality: float = 0.002


@dataclass(frozen=True, slots=True)
class MapperOptions:
    """The three steps of the paper and the incremental graph (`mapper`).

    Attributes:
        initialization: "lifted" lifts the first image alone and registers the next frames on it; "pair" is the
            paper's: the pair with most matches of valid depth, lift and PnP; "essential" uses no depth.
        registration_depth, triangulation_depth: depth residual in these steps: none, the paper's in the depth
            domain, or ours in the inverse-depth domain.
        graph_depth: depth-consistency factors with free scale and shift in the incremental graph.
        depth_weight: the paper's lambda.
        min_tracks: fewest tracked points with which a frame is registered.
        min_inliers: fewest inliers of a registered frame.
        inlier_px: largest reprojection error of an inlier at registration, widened where the map is still rough.
        keyframe_flow: median flow since the last keyframe that makes a new one (share of the image width).
        keyframe_interval: frames after which a keyframe is made at the latest.
        landmarks: landmarks of the graph that a keyframe sees.
        graph_iterations: steps of the graph at a keyframe.
        graph_delay: frames after a keyframe at which the map takes over what the graph made of it, later where the map
            has settled; until then the graph works beside the registration.
        pixel_sigma: standard deviation of a tracked point in the graph (pixels).
        essential_angle_deg: median triangulation angle that a start without depth waits for.
    """

    initialization: Literal["lifted", "pair", "essential"] = "lifted"
    registration_depth: DepthUse = "none"
    triangulation_depth: DepthUse = "inverse"
    graph_depth: bool = True
    depth_weight: float = 6.0
    min_tracks: int = 30
    min_inliers: int = 15
    inlier_px: float = 3.0
    keyframe_flow: float = 0.02
    keyframe_interval: int = 12
    landmarks: int = 600
    graph_iterations: int = 3
    graph_delay: int = 3
    pixel_sigma: float = 0.25
    essential_angle_deg: float = 1.0


@dataclass(frozen=True, slots=True)
class PolishOptions:
    """The batch polish (`refinement`).

    Attributes:
        depth: whether the prior takes part, with the weight that its own residuals justify.
        iterations: at most, until the cameras have converged on the core tracks.
        final_iterations: at most, over all tracks and the prior from there.
        tolerance: relative decrease of the cost at which a stage ends.
        kernel: scale of the Cauchy kernel in standard deviations.
        min_track_length: frames in which a track must be seen.
        point_sigma: weak prior of every inverse distance around its start, in units of the scene's median.
        max_frames: frames that are variables; in a longer shot the others are registered on the polished points.
        outlier_sigmas: tracks beyond this many robust standard deviations of all tracks are removed.
        observation_sigmas: single observations with larger errors than this many standard deviations are removed
            instead; None removes whole tracks only.
        doubtful_px: standard deviation of the errors above which a solution is doubted and other starts are tried.
    """

    depth: bool = True
    iterations: int = 60
    final_iterations: int = 4
    tolerance: float = 1e-4
    kernel: float = 2.0
    min_track_length: int = 5
    point_sigma: float = 1.0
    outlier_sigmas: float = 3.0
    observation_sigmas: float | None = None
    doubtful_px: float = 0.2
    max_frames: int = 400


@dataclass(frozen=True, slots=True)
class Options:
    """Everything that can be set.

    Attributes:
        preset: name from which the options were made.
        lens: what the polish estimates where the shot determines it: nothing, the focal length, also the radial
            distortion, or also the principal point; "radial" is the distortion alone; "zoom" is "distortion" with a
            focal length for every frame, where the shot shows that it changes; "auto" is "fixed" for a given camera and
            "distortion" for none, "all" in an image set with much parallax.
        shutter: what the polish of a video does with a rolling shutter that the shot shows. "auto": lens and points are
            free of it, and poses are those with which a camera without one would show them most nearly as the recorded
            images do; with control it is not looked for, since known poses mostly stem from what knows none. "rolling":
            poses are those of the moment at which the middle of the image is read. "global": it is not looked for.
    """

    preset: str = "default"
    lens: LensFreedom = "auto"
    shutter: ShutterUse = "auto"
    tracker: TrackerOptions = field(default_factory=TrackerOptions)
    mapper: MapperOptions = field(default_factory=MapperOptions)
    polish: PolishOptions = field(default_factory=PolishOptions)

    @classmethod
    def preset_named(cls, name: str) -> Options:
        """The options of a preset.

        Raises:
            InputError: no preset has this name.
        """
        if name not in PRESETS:
            raise InputError(f"unknown preset '{name}', expected one of {', '.join(PRESETS)}")
        return PRESETS[name]

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as written beside every result."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Options:
        """Inverse of `to_dict`.

        Raises:
            InputError: an option is unknown.
        """
        parts = {"tracker": TrackerOptions, "mapper": MapperOptions, "polish": PolishOptions}
        try:
            return cls(**{key: parts[key](**value) if key in parts else value for key, value in values.items()})
        except TypeError as error:
            raise InputError(f"these are not the options of this version: {error}") from error

    @property
    def estimates_lens(self) -> bool:
        """Whether anything of the lens is an unknown of the polish."""
        return self.lens not in ("auto", "fixed")

    @property
    def refine_focal_length(self) -> bool:
        """Whether the focal length is unknown, in the map as in the polish."""
        return self.estimates_lens and self.lens != "radial"

    def for_unknown_lens(self) -> Options:
        """What "auto" means without a camera."""
        return replace(self, lens="distortion") if self.lens == "auto" else self

    @property
    def uses_depth(self) -> bool:
        """Whether any step reads the depth prior."""
        m = self.mapper
        return (
            self.polish.depth
            or m.graph_depth
            or m.initialization != "essential"
            or m.registration_depth != "none"
            or m.triangulation_depth != "none"
        )


def _variant(name: str, mapper: MapperOptions, *, polish_depth: bool = False) -> Options:
    return replace(Options(), preset=name, mapper=mapper, polish=replace(PolishOptions(), depth=polish_depth))


_PAPER = MapperOptions(
    initialization="pair", registration_depth="paper", triangulation_depth="paper", graph_depth=False
)

PRESETS: dict[str, Options] = {
    "default": Options(),
    "paper": _variant("paper", _PAPER),
    "paper-init-only": _variant(
        "paper-init-only", replace(_PAPER, registration_depth="none", triangulation_depth="none")
    ),
    "paper-opt-only": _variant("paper-opt-only", replace(_PAPER, initialization="essential")),
    "geometry": _variant(
        "geometry",
        MapperOptions(
            initialization="essential",
            registration_depth="none",
            triangulation_depth="none",
            graph_depth=False,
        ),
    ),
}
