"""What the words of a report and of `loops.csv` mean; docs/glossary.md is written from here."""

from segslam.core.types import RejectReason

WORDS = {
    "keyframe": "A scan that is kept, about every 2 m of travel; a node of the graph. Loops join keyframes.",
    "odometry": "The pose of every scan from the scans before it. Its error grows with the travel: drift.",
    "repair": "A motion of KISS-ICP that the scans contradict, replaced by the most likely one.",
    "break": "A motion that no pose explains, or a pose that fits by chance after missing scans. The drive continues "
    "in a new part, which only loops join to the old one.",
    "submap": "The points of a keyframe and its neighbours, in its frame.",
    "candidate": "Two keyframes that may show the same place: near each other by the graph, or similar.",
    "prior": "The pose between the two that the graph predicts before they are registered.",
    "hypothesis": "A pose between two scans from matched objects or floor plans, without initial guess.",
    "overlap": "Share of the points above ground of one scan that lie on the other; the smaller of both directions.",
    "residual": "Distance of these points to the other surface; relative to its roughness where a limit applies.",
    "free space": "Where a scan saw through. A pose that puts points of the other scan there is contradicted.",
    "patch": "Points above ground in a cube of 1.5 m that face one way. It counts once, however many they are.",
    "evidence": "What the probability of a pose is made of, as differences of its log odds (nats).",
    "rival": "Another pose of the same two scans, or at another place, that fits almost as well.",
    "closure": "An accepted loop: the verified pose between two keyframes, an edge of the graph.",
    "weight": "How much the last optimisation uses a closure: 1 fully, 0 not at all.",
    "chi-square": "Squared error of an edge in units of its covariance; about 6 for a correct closure.",
    "adjustment": "The last step of a run: submaps are registered with each other, and all poses are solved again.",
    "session": "One of the runs that are merged, each in its own frame before.",
    "anchor": "The pose of a session in the frame of the merged map.",
    "position fix": "Latitude, longitude and height from a receiver, with its standard deviations.",
}
"""Word -> meaning, in the order of the pipeline."""

REASONS = {
    RejectReason.TOO_FEW_POINTS: "a scan has too few points to be registered",
    RejectReason.TOO_FEW_CORRESPONDENCES: "too few objects of one class in both scans, or no place to compare with",
    RejectReason.SMALL_CLIQUE: "too few objects are at the same distances from each other in both scans",
    RejectReason.DEGENERATE: "the matched objects do not determine a pose",
    RejectReason.TOO_FEW_INLIERS: "too few matched objects agree with the pose",
    RejectReason.FAR_FROM_PRIOR: "the pose is farther from the prior than the odometry can have drifted",
    RejectReason.REFINEMENT_DIVERGED: "the refinement moved the pose too far, or did not settle",
    RejectReason.LOW_OVERLAP: "in older logs: too little of one scan lies on the other",
    RejectReason.HIGH_RESIDUAL: "in older logs: the points lie on the other scan not closely enough",
    RejectReason.FREE_SPACE_VIOLATED: "in older logs: one scan has points where the other saw through",
    RejectReason.IMPROBABLE: "too few surfaces match, or points lie where the other scan saw through",
    RejectReason.AMBIGUOUS: "another pose, or another place, fits almost as well",
    RejectReason.NO_PLACE: "no place of the map is similar",
    RejectReason.UNCONFIRMED: "the loop waits until further loops agree with it",
}
"""Why a candidate was rejected, in the order of the pipeline."""
