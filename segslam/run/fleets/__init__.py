"""Any number of drives in one frame: each mapped on its own, related to the others, and joined where they overlap."""

from segslam.run.fleets.drives import Drive, drives_of, read_drives
from segslam.run.fleets.orchestrate import FleetResult, fleet

__all__ = ["Drive", "FleetResult", "drives_of", "fleet", "read_drives"]
