#!/usr/bin/env bash
# Runs the tests in a process a core until the first failure, after setting up what they need; 5 to 8 minutes on two
# cores. Options go to pytest: `bash tools/test.sh -m slow` runs the slow ones, `--maxfail 0` does not stop at a failure,
# `-n 0` runs all in one process.
set -euo pipefail
cd "$(dirname "$0")/.."
. tools/setup.sh dev
exec "$PYTHON" -m pytest -n "$(nproc)" --maxprocesses 4 --dist loadfile --exitfirst "$@"
