"""Find the pose of one scan in another without initial guess, from two .npy files with columns x, y, z (and more).

python docs/examples/register_scans.py source.npy target.npy
"""

import sys

import numpy as np

import segslam
from segslam.core.types import Rejected

if len(sys.argv) != 3:
    sys.exit(__doc__)

source_points, target_points = (np.load(file) for file in sys.argv[1:])
found = segslam.register(source_points, target_points)
if isinstance(found, Rejected):
    print(f"no pose: {found.reason} ({found.detail})")
else:
    print(f"overlap {found.overlap:.2f}, pose of the source in the target:")
    print(found.T_target_source.round(3))
