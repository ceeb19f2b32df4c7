"""How the world of a result was aligned."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

FREE_SCALE = "The scale is free."
_SCALES = {
    "distance": "a distance",
    "height": "the height of the camera",
    "prior": "the depth prior",
    "control": "the control",
    "imu": "the IMU",
}


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where up, the ground, the origin and the unit of a result come from; its world is x right, -y up, z ahead.

    Attributes:
        up_from: what says where up is: "imu", "photos" (phones and drones write it into them), "edges" (straight ones
            in the images), "ground", "picks"; empty if nothing does.
        up_std: standard deviation about its worst axis, degrees; None if nothing does.
        ground_from: "points" that lie on it, or "picks"; None if the ground is not known.
        ground_height, ground_std: of the ground above the origin, and standard deviation of the height of the first
            camera above the ground, units of the result; None if the ground is not known.
        ground_points: number of the points that lie on it.
        camera_height: of the first camera above the ground, units of the result.
        origin_from: "foot" of the first camera on the ground, "camera" (the first one), or "pick".
        origin_std: of a picked origin, standard deviation along the ray through the pixel, units; None otherwise.
        x_from: "camera" (the right of the first one, made level) or "pick".
        scale_from: "distance", "height" of the camera, "prior" (its metres), "control" or "imu"; None if it is free.
        scale_std: relative standard deviation of all lengths; None if unknown.
        notes: sentences on what is not known.
    """

    up_from: list[str]
    up_std: float | None
    ground_from: str | None
    ground_height: float | None
    ground_std: float | None
    ground_points: int
    camera_height: float | None
    origin_from: str
    origin_std: float | None
    x_from: str
    scale_from: str | None
    scale_std: float | None
    notes: list[str] = field(default_factory=list)

    def in_unit(self, unit: float) -> Alignment:
        """The same with all lengths `unit` times as long."""

        def scaled(length: float | None) -> float | None:
            return None if length is None else unit * length

        return replace(
            self,
            ground_height=scaled(self.ground_height),
            ground_std=scaled(self.ground_std),
            camera_height=scaled(self.camera_height),
            origin_std=scaled(self.origin_std),
        )

    def sentences(self, unit: str) -> list[str]:
        """All of it in words; `unit`: "m" or "units"."""
        said = []
        if self.up_std is not None:
            said.append(f"Up is known to {self.up_std:.2g} degrees, from {' and '.join(self.up_from)}.")
        if self.camera_height is not None and self.ground_std is not None:
            what = "three picked points" if self.ground_from == "picks" else f"{self.ground_points} points"
            said.append(
                f"The ground, on which {what} lie, is {self.camera_height:.3g} ± {self.ground_std:.2g} {unit} below "
                "the first camera."
            )
        if self.scale_from is not None:
            std = "an unknown error" if self.scale_std is None else f"{100 * self.scale_std:.2g} % (1σ)"
            said.append(f"Lengths are known to {std}, from {_SCALES.get(self.scale_from, self.scale_from)}.")
        return [*said, *self.notes]
