#!/usr/bin/env bash
# Runs the tests, after setting up what they need. Options go to pytest: `bash tools/test.sh -m slow` runs the long ones.
set -euo pipefail
cd "$(dirname "$0")/.."
. tools/setup.sh dev
exec "$PYTHON" -m pytest "$@"
