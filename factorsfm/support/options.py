"""Options: frozen dataclasses with units in the names, and the named presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from factorsfm.support.errors import InputError

# Relative standard deviations of a focal length.
DETERMINED_FOCAL_STD = 0.016  # up to this, an estimate counts as determined
GUESSED_FOCAL_STD = 0.3  # of the guess where nothing is known: fields of view of 30 to 75 degrees
GIVEN_FOCAL_STD = 0.05  # of one from EXIF data, or from a camera file and refined

LensFreedom = Literal["auto", "fixed", "focal", "radial", "distortion", "all", "zoom"]
ShutterUse = Literal["auto", "global", "rolling"]
DepthUse = Literal["none", "paper", "inverse"]


@dataclass(frozen=True, slots=True)
class TrackerOptions:
    """Tracking in video (`tracks.flow`).

    Attributes:
        max_tracks: most tracks alive at a time. More of them lie on weaker texture and take the time of a live stream.
        replenish_below: share of `max_tracks` that must be free before new tracks start.
        window_px: side of the Lucas-Kanade window. A smaller one is better on clean renders and worse on noisy clips; a
            larger one lies across the edges of things more often.
        levels: pyramid levels in the flow from frame to frame, above the image that it is sought in: the full one, or
            where its longer side has more than 1280 pixels that one halved until it has no more.
        border_px: smallest distance of a track to the image border.
        flow_check_px: largest forward-backward error of the flow from frame to frame, in pixels of that image.
        realign_check_px: largest forward-backward error of the re-alignment with the birth patch.
        realign_reach_px: largest correction by the re-alignment.
        corner_quality: Shi-Tomasi score of the weakest corner, as a share of the strongest in the image.
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
    """The three steps of the paper and the incremental graph (`mapping`).

    Attributes:
        initialization: "lifted" lifts the tracks of the first image by its depth and registers the next frames on them;
            "pair" is the paper's: it lifts one image of the pair with the most matches of valid depth and finds the
            other by PnP; "essential" uses no depth.
        registration_depth, triangulation_depth: depth residual in these steps: none, the paper's ("paper", of depth),
            or that of inverse depth ("inverse").
        graph_depth: whether the incremental graph has depth-consistency factors, with a scale and a shift per keyframe.
        depth_weight: the paper's lambda.
        min_tracks: fewest tracked points with which a frame is registered.
        min_inliers: fewest inliers of a registered frame.
        inlier_px: largest reprojection error of an inlier at registration; larger while the map is still inaccurate.
        keyframe_flow: median flow since the last keyframe that makes the next one, as a share of the image width.
        keyframe_seconds: longest time between two keyframes, while they are few.
        landmarks: most landmarks that a keyframe observes in the graph.
        graph_iterations: iterations of the graph at a keyframe.
        graph_delay_seconds: time from a keyframe until the map takes over its update; more once the map has
            converged. Until then the graph works in parallel with the registration.
        pixel_sigma: standard deviation of a tracked point in the graph (pixels).
        essential_angle_deg: median triangulation angle that a start without depth needs.
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
    keyframe_seconds: float = 0.5
    landmarks: int = 600
    graph_iterations: int = 1
    graph_delay_seconds: float = 0.125
    pixel_sigma: float = 0.25
    essential_angle_deg: float = 1.0


@dataclass(frozen=True, slots=True)
class PolishOptions:
    """The batch polish (`polish`).

    Attributes:
        depth: whether the depth prior takes part; its residuals determine its weight.
        iterations: most iterations of the first stage, which solves for the cameras on the core tracks.
        final_iterations: most iterations of the second stage, over all tracks and the prior.
        tolerance: relative decrease of the cost below which a stage ends.
        kernel: scale of the Cauchy kernel in standard deviations.
        min_track_length: fewest frames that observe a track.
        point_sigma: standard deviation of a weak prior on every inverse distance around its start, in units of the
            scene's median.
        max_frames: most frames that are variables; the others of a longer shot are registered on the polished points.
        outlier_sigmas: a track whose error exceeds this many robust standard deviations of all tracks is removed.
        observation_sigmas: single observations whose error exceeds this many standard deviations are removed instead;
            None removes whole tracks only.
        doubtful_px: standard deviation of the reprojection errors above which other starts are tried.
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
        preset: name of the preset from which the options were made.
        lens: what the polish estimates, as far as the shot determines it. "fixed": nothing; "focal": the focal length;
            "radial": the radial distortion; "distortion": both; "all": also the principal point; "zoom": "distortion"
            with a focal length for every frame, if the shot shows that it changes; "auto": "fixed" if a camera is
            given, otherwise "distortion", or "all" in an image set with much parallax.
        shutter: what the polish of a video does about a rolling shutter. "auto" estimates the readout and removes its
            effect from lens and points; the poses are those of a global shutter that reproduce the recorded images
            best. With control, "auto" assumes a global shutter, because known poses usually do. "rolling" gives the
            poses at the time when the middle of the image is read. "global" assumes a global shutter.
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
        """Plain data, as `summary.json` holds it."""
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
        """Whether the polish estimates any part of the lens."""
        return self.lens not in ("auto", "fixed")

    @property
    def refine_focal_length(self) -> bool:
        """Whether the mapper and the polish estimate the focal length."""
        return self.estimates_lens and self.lens != "radial"

    def for_unknown_lens(self) -> Options:
        """The options for a shot without a camera: "auto" becomes "distortion"."""
        return replace(self, lens="distortion") if self.lens == "auto" else self

    def for_image_sets(self) -> Options:
        """The options for images in any order: wrong matches are single observations, and two views make a track.

        Keypoints are less exact than tracks of a video. Where views are far apart the prior adds nothing to
        triangulation and graph; the paper's presets triangulate with it all the same.
        """
        depth = self.mapper.triangulation_depth
        mapper = replace(
            self.mapper, pixel_sigma=0.5, graph_depth=False, triangulation_depth="none" if depth == "inverse" else depth
        )
        polish = replace(self.polish, min_track_length=2, final_iterations=20, observation_sigmas=12.0, doubtful_px=0.6)
        return replace(self, mapper=mapper, polish=polish)

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


def _variant(name: str, mapper: MapperOptions) -> Options:
    """A preset without the prior in the polish."""
    return replace(Options(), preset=name, mapper=mapper, polish=replace(PolishOptions(), depth=False))


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
