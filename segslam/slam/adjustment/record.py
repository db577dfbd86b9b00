"""The record of an adjustment, as the log keeps it."""

from dataclasses import dataclass

from segslam.core.short_repr import Record


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Adjustment(Record):
    """The adjustment of a drive, beside its estimate."""

    num_pairs: int
    """Number of pairs of submaps chosen in the last round."""
    num_registered: int
    """Number of these whose registration converged with enough overlap; each is a factor of the graph."""
    num_between_passes: int
    """Number of factors between different passes of a place."""
    odometry_noise_factor: float
    """Standard deviations of the odometry on this drive, relative to those of the settings."""
    noise_factor: float
    """The same of the factors, relative to those of single registrations."""
    moved_m: float
    """Root mean square distance by which keyframes moved."""
    is_complete: bool
    """False if the time limit ended it early."""
    seconds: float
    vertical_deg: float | None = None
    """Remaining vertical angle of the scans; positive if their points are too low. None if it was not measured."""
    vertical_sigma_deg: float | None = None
    correction_deg: float = 0.0
    """Elevation added to all points of the keyframes, for the adjustment and for the map; 0 if not significant."""
    thickness_before_m: float | None = None
    """Thickness of surfaces in the map (`thickness`) before the adjustment; None if no surface was seen twice."""
    thickness_m: float | None = None
    """The same after it."""

    def figures(self) -> dict[str, float]:
        """The figures of `metrics.json`; unknown ones are omitted. The vertical angle is that left in the scans."""
        figures = {
            "vertical_deg": self.vertical_deg,
            "vertical_sigma_deg": self.vertical_sigma_deg,
            "vertical_correction_deg": self.correction_deg or None,
            "map_thickness_before_m": self.thickness_before_m,
            "map_thickness_m": self.thickness_m,
            "num_submap_pairs": self.num_registered,
            "adjustment_moved_m": self.moved_m,
        }
        return {name: value for name, value in figures.items() if value is not None}
