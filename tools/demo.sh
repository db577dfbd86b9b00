#!/usr/bin/env bash
# Simulates a small street sequence, maps it, evaluates it and draws it, after setting up what that needs.
# Options go to `segslam demo`, for example: bash tools/demo.sh --out runs/demo
set -euo pipefail
cd "$(dirname "$0")/.."
. tools/setup.sh ''
exec "$PYTHON" -m segslam demo "$@"
