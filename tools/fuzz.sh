#!/usr/bin/env bash
# Gives damaged files to all readers: `bash tools/fuzz.sh [MINUTES] [READER ...]`, five minutes by default. Other inputs
# every time; `--seed N` repeats a run. What a reader must not do is listed, with the smallest file in build/fuzz.
set -euo pipefail
cd "$(dirname "$0")/.."
. tools/setup.sh dev
seed=$(date +%s)
echo "fuzz: --seed $seed"
PYTHONPATH=.:tests exec "$PYTHON" -m fuzz --seed "$seed" "${@:-5}"
