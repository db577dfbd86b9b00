"""The score of a pose: how probable it is, learnt and tested on pairs of scans whose poses are known.

    python -m tools.benchmarks.score describe DATA --out FILE.pickle [--parts corridor,nclt] [--pairs 5] [--seed 40]
    python -m tools.benchmarks.score learn FILE.pickle ... --table segslam/verification/score.json
    python -m tools.benchmarks.score test FILE.pickle ... [--learnt FILE.pickle ...] --out FILE.json

`describe` registers pairs as a run does and stores what the scans show at each pose that was tried; that takes about a
second a pair. `learn` writes the table that the package ships, calibrated on what each part is given by all others.
`test` prints, for each part, what the package accepted, and what a table learnt from all other parts accepts; with
`--learnt` such a table is learnt from other files, so that neither places nor seeds are those that are tested.
"""
