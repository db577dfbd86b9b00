"""One score for a pose between two scans, in the shadow of the gates: how much likelier are the scans if it is right.

    python -m tools.benchmarks.score DATA --out FILE.json [--parts corridor,kitti_whole] [--pairs 5] [--seed 21]

Each pair is registered and verified as in a run, and then scored: its poses, slides along the weakest direction among
them, are refined, and each is described by what its patches show (`evidence`). Tables of how often right and wrong
poses show it, and the weights of match and uniqueness, are learnt from the other parts (`ratio`): a part never scores
itself. Prints for each part what the gates and the score accept, and the curve of the score over all parts.
"""
