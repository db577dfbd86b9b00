# Sourced by the other scripts: makes all that segslam needs on a fresh Debian or Ubuntu machine, and reuses it after.
# Sets PYTHON to the interpreter of the virtual environment (.venv, or the folder that SEGSLAM_VENV names).
# Usage: . tools/setup.sh EXTRA        EXTRA: an extra of pyproject.toml, such as dev, or empty

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=${SEGSLAM_VENV:-$root/.venv}
extra=$1

install_packages() {
    local sudo=
    if [ "$(id -u)" != 0 ]; then
        command -v sudo >/dev/null || { echo "setup: as root, run: apt-get install $*" >&2; return 1; }
        sudo=sudo
    fi
    echo "installing system packages: $*" >&2
    $sudo apt-get update -qq >&2 || return
    $sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >&2
}

# Sets `python` to the first interpreter that segslam runs on and that can make a virtual environment.
find_python() {
    for python in python3 python3.13 python3.12 python3.11; do
        "$python" -c 'import sys, ensurepip, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' \
            2>/dev/null && return
    done
    return 1
}

system_packages() {
    local missing=() libraries
    libraries=$(PATH=$PATH:/sbin ldconfig -p)  # no pipe: `grep -q` ends it early, which pipefail takes for a failure
    # What Open3D's wheel loads, by the library that it asks for.
    for pair in libusb-1.0.so.0=libusb-1.0-0 libGL.so.1=libgl1 libEGL.so.1=libegl1 libgomp.so.1=libgomp1; do
        [[ $libraries == *"${pair%%=*}"* ]] || missing+=("${pair##*=}")
    done
    find_python || python3 -c 'import ensurepip, venv' 2>/dev/null || missing+=(python3 python3-venv)
    if [ ${#missing[@]} -gt 0 ]; then
        command -v apt-get >/dev/null || { echo "setup: install by hand: ${missing[*]}" >&2; return 1; }
        install_packages "${missing[@]}" || return
    fi
}

python_packages() {
    local wanted stamp="$venv/.segslam-installed"
    wanted=$(cat "$root/pyproject.toml" <(printf '%s\n%s\n' "$root" "$extra") | sha256sum)
    grep -qsxF "$wanted" "$stamp" && return
    find_python || {
        echo "setup: needs Python 3.11 to 3.13 with its venv module, $(python3 --version 2>&1) is what there is (kiss-icp" \
            "has no wheel for 3.14). Install python3.13 and python3.13-venv, or: uv python install 3.13" >&2
        return 1
    }
    [ -x "$venv/bin/python" ] || "$python" -m venv "$venv" || return
    echo "installing Python packages into $venv" >&2
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable "$root${extra:+[$extra]}" >&2 || return
    "$venv/bin/python" -m segslam warm-up >&2 || return
    echo "$wanted" >> "$stamp"
}

system_packages && python_packages || exit 1
PYTHON=$venv/bin/python
