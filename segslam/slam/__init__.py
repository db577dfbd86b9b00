"""The pipeline: odometry, keyframe, candidates, registration, verification, graph; then the adjustment of the map."""
